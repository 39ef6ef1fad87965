# Warp kernels are a language of their own in Python's clothes: their annotations are not Python types.
from typing import Any

def __getattr__(name: str) -> Any: ...
