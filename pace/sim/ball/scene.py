"""What a ball can meet, its own numbers, and their contact materials, as Warp structs and functions."""

import warp as wp

from pace.sim.ball.aero import Air, AirTables, air_factors
from pace.sim.ball.rebound import Material
from pace.sim.ball.robot_body import RobotBody

NOTHING = wp.constant(-1)
TABLE = wp.constant(0)
NET = wp.constant(1)
FLOOR = wp.constant(2)
PADDLE = wp.constant(3)
BODY = wp.constant(4)
#: Surfaces below this number stand still; the forecast meets only these.
STATIC_SURFACES = 3
ALL_SURFACES = 5


class Gaps(wp.types.vector(length=ALL_SURFACES, dtype=wp.float32)):
    """A gap (m) to each surface."""


@wp.struct
class Body:
    """The ball of one world."""

    radius: wp.float32
    mass: wp.float32
    air: Air
    table: Material
    paddle: Material


@wp.struct
class Scene:
    """What the ball can meet, the knots of the paddle's path and the robot's shapes in one control step."""

    table_centre: wp.vec3
    table_half: wp.vec3
    net_centre: wp.vec3
    net_half: wp.vec3
    net: Material
    floor: Material
    skin: Material  # of the robot's body
    paddle_radius: wp.float32
    paddle_half_thickness: wp.float32
    path: wp.array3d[wp.float32]  # (N, S + 1, 12): centre, unit normal, linear and angular velocity
    path_dt: wp.float32  # s between knots
    robot: RobotBody
    air: AirTables


@wp.func
def read_body(params: wp.array2d[wp.float32], world: int) -> Body:
    """The ball of ``world`` from its row of :data:`pace.sim.ball.ball.PARAM_NAMES`."""
    body = Body()
    body.mass = params[world, 0]
    body.radius = params[world, 1]
    drag, magnus, table_drag, table_lift = params[world, 3], params[world, 4], params[world, 12], params[world, 13]
    body.air = air_factors(params[world, 2], drag, magnus, table_drag, table_lift, body.radius, body.mass)
    body.table.restitution = params[world, 5]
    body.table.slope = params[world, 6]
    body.table.friction = params[world, 7]
    body.paddle.restitution = params[world, 8]
    body.paddle.slope = params[world, 9]
    body.paddle.friction = params[world, 10]
    body.table.lowest = params[world, 11]
    body.paddle.lowest = params[world, 11]
    body.table.tangential = params[world, 14]
    body.paddle.tangential = params[world, 15]
    body.paddle.tangential_slope = params[world, 16]
    body.paddle.drilling_loss = params[world, 17]
    return body


@wp.func
def material_of(surface: int, body: Body, scene: Scene) -> Material:
    """Contact material of the ball with ``surface``."""
    if surface == TABLE:
        return body.table
    if surface == NET:
        return scene.net
    if surface == FLOOR:
        return scene.floor
    if surface == BODY:
        return scene.skin
    return body.paddle
