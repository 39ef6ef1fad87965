"""Speed and memory of every part of training, beside the limits that others set.

Here belongs what measures this machine; nothing that training itself needs. Imports ``rl`` and the rooms below.
``python -m pace.bench`` measures.
"""
