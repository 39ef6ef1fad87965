"""Two environments of one seed, under one of Warp's guarantees: ``python -m tests.gpu.seeds MODE DEVICE WORLDS MARKS``.

A separate process: the guarantee must be chosen before Warp's modules are made. Prints one line of JSON.
"""

from __future__ import annotations

import json
import sys

import torch
import warp as wp


def main() -> None:
    mode, name, worlds, marks = sys.argv[1], sys.argv[2], int(sys.argv[3]), [int(m) for m in sys.argv[4].split(",")]
    wp.config.deterministic = wp.DeterministicMode[mode]
    from pace.rl.kernels import warm
    from tests.gpu.measure import apart, captured, config_of, environment, play

    device = torch.device(name)
    graph = captured(device)
    warm(config_of(device, worlds, graph), device)
    played = []
    for _ in range(2):
        env = environment(device, worlds, graph)
        played.append((*play(env, marks), env.pop_statistics()))
    counts = [{key: float(counted[key]) for key in ("serves", "hits", "falls")} for *_, counted in played]
    print(json.dumps({"rows": apart(played[0][0], played[1][0]), "ms": played[1][1], "counts": counts}))


if __name__ == "__main__":
    main()
