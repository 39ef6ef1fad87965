"""Outcomes of a serve."""

from enum import IntEnum


class Outcome(IntEnum):
    """Outcome of a serve. All but ``OPEN`` and ``BAD_SERVE`` count in the rates."""

    OPEN = 0  # not decided yet
    SUCCESS = 1  # hit, then landed first on the opponent's half
    MISS = 2  # the ball passed, fell or bounced twice before a hit
    NET = 3  # hit, touched the net and did not get over
    OUT = 4  # hit, then landed beside or beyond the table
    OWN_SIDE = 5  # hit, then bounced on the own half
    DOUBLE_HIT = 6  # a second paddle contact before the ball landed
    VOLLEY = 7  # paddle contact before the bounce on the own half
    FALL = 8  # the robot fell or left its area before the serve was decided
    BAD_SERVE = 9  # the serve never bounces on the robot's half: not the robot's fault
    BODY = 10  # the ball touched the robot's body, arms, legs or head, before or after the hit
    TABLE_TOUCH = 11  # a part of the robot pushed the table so that it would move
    FREE_HAND = 12  # the free hand touched the playing surface
