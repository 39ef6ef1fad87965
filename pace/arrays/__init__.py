"""Torch tensors and Warp arrays on one memory: structs of arrays, launches by name, random samples, graphs, state.

Tools that every kernel needs belong here, not the kernels of one subject. Imports ``config`` and ``devices``."""

import warp as wp

from pace.arrays.kernel_cache import init_warp

# Warp compiles each module once per setting, so both must be set before the first kernel is defined.
wp.config.enable_backward = False  # nothing here is differentiated; adjoint code doubles the compilation
wp.config.log_level = wp.LOG_WARNING  # no banner and no line per module that is loaded
init_warp()  # wp.device_from_torch does not do it by itself
