"""The optional packages: how to install those of an extra."""

from __future__ import annotations

import re
from importlib.metadata import PackageNotFoundError, requires

DISTRIBUTION = "pace-table-tennis"


def cure(extra: str) -> str:
    """The command that installs the packages of ``extra``, by their own names: so it works for a checkout and for a
    wheel from a file, too."""
    try:
        needed = requires(DISTRIBUTION) or []
    except PackageNotFoundError:  # a checkout that is not installed
        needed = []
    own = [re.split(r"\s*;", line)[0] for line in needed if re.search(rf"extra\s*==\s*['\"]{extra}['\"]", line)]
    return f"pip install {' '.join(map(repr, own))}" if own else f"pip install -e '.[{extra}]'"
