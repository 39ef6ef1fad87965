# Written in Warp; see typings/warp.
from typing import Any

def __getattr__(name: str) -> Any: ...
