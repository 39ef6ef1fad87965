"""What every engine does with the states that it shows, as Warp kernels, one thread a world."""

from typing import Any

import warp as wp


@wp.kernel
def reset_state(
    mask: wp.array[wp.bool],
    qpos: wp.array2d[wp.float32],
    qvel: wp.array2d[wp.float32],
    own_qpos: wp.array2d[Any],
    own_qvel: wp.array2d[Any],
    warmstart: wp.array2d[Any],
    qpos_path: wp.array3d[wp.float32],
    qvel_path: wp.array3d[wp.float32],
    foot_force: wp.array3d[wp.float32],
    body_contact: wp.array2d[wp.float32],
    joint_torque: wp.array2d[wp.float32],
):
    """Put a masked world into the state qpos, qvel: at rest in it through the whole path, touching nothing."""
    world = wp.tid()
    if not mask[world]:
        return
    for i in range(qpos.shape[1]):
        own_qpos[world, i] = own_qpos.dtype(qpos[world, i])
        for instant in range(qpos_path.shape[1]):
            qpos_path[world, instant, i] = qpos[world, i]
    for i in range(qvel.shape[1]):
        own_qvel[world, i] = own_qvel.dtype(qvel[world, i])
        warmstart[world, i] = warmstart.dtype(0.0)
        for instant in range(qvel_path.shape[1]):
            qvel_path[world, instant, i] = qvel[world, i]
    for foot in range(foot_force.shape[1]):
        for i in range(foot_force.shape[2]):
            foot_force[world, foot, i] = 0.0
    for i in range(body_contact.shape[1]):
        body_contact[world, i] = 0.0
    for i in range(joint_torque.shape[1]):
        joint_torque[world, i] = 0.0
