"""Threads of torch that wait sleep, and take no processor time from other programs."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest


def spin_count(**chosen: str) -> int:
    """How often a thread of libgomp looks for work before it sleeps, in a process that imports pace before torch."""
    settings = {name: value for name, value in os.environ.items() if not name.startswith(("OMP_", "GOMP_"))}
    told = subprocess.run(
        [sys.executable, "-c", "import pace, torch; torch.ones(9).sum()"],
        env=settings | {"OMP_DISPLAY_ENV": "VERBOSE"} | chosen,
        capture_output=True,
        text=True,
        check=True,
    ).stderr
    found = re.search(r"GOMP_SPINCOUNT = '(\w+)'", told)
    if found is None:
        pytest.skip("this torch has another OpenMP than libgomp")
    return sys.maxsize if found[1] == "INFINITY" else int(found[1])


def test_threads_sleep_while_they_wait() -> None:
    assert spin_count() == 0


def test_what_a_user_sets_stays() -> None:
    assert spin_count(OMP_WAIT_POLICY="ACTIVE") > 0
    assert spin_count(GOMP_SPINCOUNT="123") == 123
