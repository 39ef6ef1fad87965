"""The folder of a run: checkpoints, metrics, progress, interruption, and queues of runs.

Reading and writing a run's files belongs here, whatever is trained, not the meaning of the tensors. Imports
``config``, ``arrays`` and ``command``.
"""
