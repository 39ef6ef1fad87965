"""Names of the default robot's parts."""

from __future__ import annotations

from pace.config.training import load_train_config
from pace.sim.robot_spec import RobotSpec

SPEC = RobotSpec.of(load_train_config().robot)
JOINT_NAMES, CONTACT_BODIES = SPEC.joints, SPEC.contacts
