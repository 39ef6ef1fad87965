"""Speed and memory of every part of training, compared with reference limits.

Measurements of this machine belong here, not code that training needs. Imports ``rl`` and the rooms below.
``python -m pace.bench`` measures.
"""
