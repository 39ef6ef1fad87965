"""Physics of N table-tennis worlds: the robot, the ball and what the robot senses. Knows nothing of learning."""

import warp as wp

# Warp compiles each module once per setting, so both must stand before the first kernel is defined.
wp.config.enable_backward = False  # nothing here is differentiated; adjoint code doubles the compilation
wp.config.log_level = wp.LOG_WARNING  # no banner and no line per module that is loaded
wp.init()  # wp.device_from_torch does not do it by itself
