"""Broken and hostile files of a run, many of them: loaded as saved, or one line; nothing runs, nothing grows."""

from __future__ import annotations

import gzip
import io
import json
import pickle
import resource
import struct
import subprocess
import sys
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch

from pace.rl.policies import load_policy
from pace.runs.checkpoint import META, TRAINING, WEIGHTS, CheckpointError, load_checkpoint
from pace.runs.metrics_file import MetricsFile, read_rows
from pace.runs.run_folder import RunFolder
from tests.helpers.examples import assert_one_line, check, counts, counts_of, json_values, st
from tests.helpers.saved import save_run
from tests.helpers.training import dummy_trainer

GIB = 2**30


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of a checkpoint with training state."""
    run = tmp_path_factory.mktemp("run")
    dummy_trainer(run, 1).train()
    folder = run / "checkpoints" / "update_00000001"
    return {file.name: file.read_bytes() for file in folder.iterdir()}


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of a policy."""
    folder = save_run(tmp_path_factory.mktemp("policy")) / "checkpoints" / "update_00000003"
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def write(folder: Path, files: dict[str, bytes]) -> Path:
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return folder


def load(path: Path, function: Callable[[Path], Any] = load_checkpoint) -> None:
    try:
        function(path)
    except CheckpointError as error:
        assert_one_line(error)


def damages() -> Any:
    """A change of a file's bytes: cut, flipped, or another part in the middle."""
    place = st.floats(0.0, 1.0, exclude_max=True)
    cut = place.map(lambda at: lambda data: data[: int(at * len(data))])
    flip = st.tuples(place, st.integers(1, 255)).map(lambda how: lambda data: flipped(data, *how))
    insert = st.tuples(place, st.binary(max_size=20)).map(lambda how: lambda data: inserted(data, *how))
    return st.lists(st.one_of(cut, flip, insert), min_size=1, max_size=3)


def flipped(data: bytes, at: float, bits: int) -> bytes:
    changed = bytearray(data)
    if changed:
        changed[int(at * len(changed))] ^= bits
    return bytes(changed)


def inserted(data: bytes, at: float, more: bytes) -> bytes:
    return data[: int(at * len(data))] + more + data[int(at * len(data)) :]


@counts_of(334)
@pytest.mark.parametrize("name", [META, WEIGHTS, TRAINING])
def test_damaged_bytes(name: str, count: int, original: dict[str, bytes], tmp_path: Path) -> None:
    @check(count, damages())
    def example(changes: list[Callable[[bytes], bytes]]) -> None:
        data = original[name]
        for change in changes:
            data = change(data)
        load(write(tmp_path, original | {name: data}))


@counts
def test_any_json_in_place_of_any_part(count: int, policy: dict[str, bytes], tmp_path: Path) -> None:
    meta = json.loads(policy[META])
    parts = [*((key,) for key in meta), *(("config", key) for key in meta["config"])]
    parts += [("weights", "agent"), ("weights", "predictor"), ("counters", "samples")]

    @check(count, st.sampled_from(parts), json_values())
    def example(part: tuple[str, ...], value: Any) -> None:
        changed = json.loads(policy[META])
        inner = changed
        for key in part[:-1]:
            inner = inner[key]
        inner[part[-1]] = value
        folder = write(tmp_path, policy | {META: json.dumps(changed).encode()})
        load(folder)
        if count < 100 or part[0] != "config":  # to read a whole configuration takes half a second
            load(folder, load_policy)


def safetensors(header: bytes, length: int | None = None, data: bytes = b"") -> bytes:
    return struct.pack("<Q", len(header) if length is None else length) + header + data


class Bomb:
    """Something that runs when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return exec, ("open('ran', 'w').close()",)


@cache
def zip_bomb() -> bytes:
    """A GiB of zeros in a MiB."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("data.pkl", "w") as member:
        for _ in range(64):
            member.write(bytes(16 * 2**20))
    return packed.getvalue()


def pickled(content: Any) -> bytes:
    saved = io.BytesIO()
    torch.save(content, saved)
    return saved.getvalue()


HOSTILE = {
    "pickle": pickle.dumps(Bomb()),
    "torch": pickled({"agent": Bomb()}),
    "zip bomb": zip_bomb,
    "gzip": gzip.compress(bytes(2**20)),
    "huge header": safetensors(b"{}", 2**63),
    "header beyond the file": safetensors(b"{}", 2**32),
    "tensor beyond the file": safetensors(
        b'{"a":{"dtype":"F32","shape":[1099511627776],"data_offsets":[0,4398046511104]}}'
    ),
    "shape that overflows": safetensors(
        b'{"a":{"dtype":"F32","shape":[4294967296,4294967296,4],"data_offsets":[0,0]}}'
    ),
    "overlapping tensors": safetensors(
        b'{"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]},"b":{"dtype":"F32","shape":[2],"data_offsets":[4,12]}}',
        data=bytes(12),
    ),
    "deep header": safetensors(b"[" * 100_000),
    "nothing": b"",
}  # fmt: skip


@pytest.mark.parametrize("name", [META, WEIGHTS, TRAINING])
@pytest.mark.parametrize("hostile", HOSTILE)
def test_hostile_files_run_nothing_and_fill_no_memory(
    name: str, hostile: str, original: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    content = HOSTILE[hostile]
    write(tmp_path, original | {name: content if isinstance(content, bytes) else content()})
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(CheckpointError) as error:
        load_checkpoint(tmp_path)
    assert_one_line(error.value)
    assert not (tmp_path / "ran").exists()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < GIB / 4 / 1024  # KiB


@pytest.mark.parametrize(
    "text",
    [
        "[" * 200_000, '{"a":' * 100_000, '{"format": 4, "config": ' + "[" * 50_000, "9" * 1_000_000,
        '{"format": 1e999}',
        '{"format": true, "config": {}, "counters": {}, "weights": {}, "training": null}', "null", '"format"',
        '{"format": 4, "config": [], "counters": [], "weights": [], "training": []}',
        '{"format": 4, "config": {}, "counters": {}, "weights": {"a": {"__tensor__": ["a"]}}, "training": null}',
        '{"format": 4, "config": {}, "counters": {}, "weights": {"a": {"__tensor__": {}}}, "training": null}',
    ],
)  # fmt: skip
def test_hostile_descriptions(text: str, original: dict[str, bytes], tmp_path: Path) -> None:
    folder = write(tmp_path, original | {META: text.encode()})
    load(folder)
    with pytest.raises(CheckpointError):
        load_policy(folder)


@pytest.mark.long
def test_a_training_does_not_start_from_hostile_weights(original: dict[str, bytes], tmp_path: Path) -> None:
    """The commands, too, end in one line."""
    write(tmp_path, original | {WEIGHTS: pickle.dumps(Bomb())})
    for given in (f"resume={tmp_path}", f"init_from={tmp_path}", f"predictor_from={tmp_path}"):
        done = subprocess.run(
            [sys.executable, "-m", "pace.rl.train", given], cwd=tmp_path, capture_output=True, text=True, check=False,
            env={"PYTHONPATH": str(Path(__file__).parents[2]), "PATH": "/usr/bin:/bin"},
        )  # fmt: skip
        assert done.returncode == 1
        assert "Traceback" not in done.stderr
        assert f"{WEIGHTS} is broken" in done.stderr
        assert not (tmp_path / "ran").exists()


@counts
def test_metrics_of_any_text_are_read_and_continued(count: int, tmp_path: Path) -> None:
    head = "update,samples,kl\n"
    line = st.one_of(st.tuples(st.integers(0, 9), st.integers(), st.floats()).map(lambda row: ",".join(map(str, row))))
    text = st.lists(st.one_of(line, st.text(max_size=20)), max_size=6).map(lambda lines: head + "\n".join(lines))

    @check(count, st.one_of(text, st.text(), st.binary().map(lambda data: data.decode(errors="replace"))))
    def example(content: str) -> None:
        columns, rows = read_rows(content)
        assert all(list(row) == columns and row["update"].isdigit() for row in rows)
        file = tmp_path / "metrics.csv"
        file.write_text(content, newline="")
        metrics = MetricsFile(file, 5)
        metrics.add({"update": 6.0, "samples": 60.0})
        metrics.close()
        kept = [row["update"] for row in read_rows(file.read_text())[1]]
        assert kept[-1] == "6"
        assert all(int(update) <= 5 for update in kept[:-1])


def test_the_folder_of_a_run_holds_nothing_that_runs(tmp_path: Path) -> None:
    """config.yaml with Python tags is no run's, and is not evaluated."""
    (tmp_path / "config.yaml").write_text("robot: !!python/object/apply:os.system ['touch ran']\nalgo: 1\n")
    with pytest.raises(Exception, match=r"config\.yaml is no file that pace has written there"):
        RunFolder(tmp_path, {}, False)
    assert not Path("ran").exists()
