"""In place of ``python -m pace.rl.train``: takes its arguments and keeps its files, without learning anything.

``experiment=fails`` ends with an error after its first checkpoint; ``experiment=slow`` waits for Ctrl-C, and saves.
"""

import json
import signal
import sys
import time
from pathlib import Path

ROW = 1_000  # control steps of a row of metrics


def save(folder: Path, update: int) -> None:
    """A checkpoint that a queue can read."""
    checkpoint = folder / "checkpoints" / f"update_{update:08d}"
    checkpoint.mkdir(parents=True)
    counters = {"updates": update, "samples": update * ROW}
    meta = {"format": 1, "config": {}, "counters": counters, "weights": {}, "training": None}
    (checkpoint / "checkpoint.json").write_text(json.dumps(meta))


def main() -> int:
    """Play the part."""
    given = dict(argument.split("=", 1) for argument in sys.argv[1:])
    folder = Path((given.get("resume") or given["out"]).strip("'"))
    folder.mkdir(parents=True, exist_ok=True)
    print(" ".join(sys.argv[1:]), flush=True)
    updates = int(float(given["samples"])) // ROW
    rows = [f"{u},{u * ROW},{u},{u / updates},{u / updates / 2},{1 / u}" for u in range(1, updates + 1)]
    head = "update,samples,wall_s,hit_rate,success_rate,fall_rate"
    (folder / "metrics.csv").write_text("\n".join([head, *rows]) + "\n")
    if given.get("experiment") == "fails":
        save(folder, 1)
        print("error: it fell over")
        return 1
    if given.get("experiment") == "slow":
        stopped = []
        signal.signal(signal.SIGINT, lambda *_: stopped.append(True))
        (folder / "ready").touch()
        while not stopped:
            time.sleep(0.02)
        updates //= 2
    save(folder, updates)
    return 0


if __name__ == "__main__":
    sys.exit(main())
