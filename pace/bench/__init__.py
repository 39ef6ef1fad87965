"""``python -m pace.bench``: speed and memory of every part of training, beside the limits that others set."""
