"""The folder of a run: checkpoints, metrics, progress, interruption, and queues of runs.

Here belongs what is written to disk and read back, whatever is trained; not what is in the tensors. Imports ``config``,
``arrays`` and ``command``.
"""
