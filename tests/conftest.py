"""Settings of the whole test suite."""

import torch

torch.set_num_threads(1)  # tests work on small tensors: more threads would mostly wait for each other
