"""``pace`` and its commands: the list, the help, and one line for what is written wrong."""

from __future__ import annotations

import errno
import os
import runpy
import signal
import subprocess
import sys
import tomllib
from pathlib import Path
from pkgutil import resolve_name

import pytest

from pace.__main__ import main
from pace.command import Terminated, run_command
from pace.command.arguments import quote
from pace.command.help import WIDTH, command_help, command_keys
from pace.command.keys import file_keys, heading
from pace.command.table import COMMANDS, Command
from pace.config.base import compose, config_dir
from pace.config.extras import cure
from pace.config.names import choices
from pace.config.renamed import RENAMED_CHOICES
from pace.moved import MOVED

pytestmark = pytest.mark.filterwarnings("ignore:.*found in sys.modules")  # a command runs once for each process


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    """``pace ...`` in this process; returns its exit status."""
    monkeypatch.setattr(sys, "argv", ["pace", *arguments])
    try:
        return main()
    except SystemExit as end:
        return int(end.code or 0)


def error_line(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line on stderr of a command that is used wrongly."""
    assert run(monkeypatch, *arguments) == 2
    lines = [line for line in capfd.readouterr().err.splitlines() if not line.startswith("Warp")]
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    return lines[0].removeprefix("error: ")


def test_commands_are_listed_a_line_each(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in ((), ("--help",), ("help",)):
        assert run(monkeypatch, *arguments) == 0
        lines = capsys.readouterr().out.splitlines()
        assert [line.split()[1] for line in lines if line.startswith("  pace ")] == list(COMMANDS)
        assert max(len(line) for line in lines) <= 110


def test_help_loads_neither_torch_nor_warp() -> None:
    code = "import sys, runpy\nsys.argv = sys.argv[1:]\ntry: runpy.run_module({!r}, run_name='__main__')\n"
    code += "except SystemExit: pass\nprint(sorted({{'torch', 'warp', 'mujoco'}} & set(sys.modules)))"
    for module in ("pace", *(command.module for command in COMMANDS.values())):
        given = [sys.executable, "-c", code.format(module), "pace", "--help"]
        done = subprocess.run(given, capture_output=True, text=True, timeout=60)
        assert done.stdout.endswith("[]\n"), module
        assert done.stderr == ""


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_help_shows_every_key_of_the_command_with_its_default_and_nothing_else(name: str) -> None:
    command, text = COMMANDS[name], command_help(name)
    composed = compose(command.config)
    assert text.startswith(f"pace {name} {command.usage}\n")
    assert f"python -m {command.module}" in text
    assert f"{command.summary[1:]}." in text
    assert all(len(line) <= WIDTH for line in text.splitlines() if f"  pace {name}" not in line)
    shown = {line.split("=")[0].strip() for line in text.splitlines() if line.startswith("  ") and "=" in line}
    for key in command_keys(command):
        assert key in shown
    groups = {key for key in composed if (config_dir() / str(key)).is_dir()}
    given = {str(key) for key in composed} - groups - {"overrides"}
    if name not in ("bench", "predictor", "ablate", "warm"):  # those take a part of the training's keys
        assert {key.split(".")[0] for key in command_keys(command)} == given | set(command.training_keys)
    assert all(f"  {group}=" in text or f"  {group}.KEY=" in text for group in command.groups)
    assert ("--help GROUP" in text) == bool(command.groups)


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_every_key_of_a_command_is_explained(name: str) -> None:
    exempt = ("paper.", "variations.engine")
    assert [
        key.name for key in command_keys(COMMANDS[name]).values() if not key.comment and not key.name.startswith(exempt)
    ] == []


def test_a_group_is_shown_with_the_units_of_its_file() -> None:
    text = command_help("train", "serve")
    assert "serve.vx=[-6.5, -5.0]" in text
    assert "m/s" in text.split("serve.vx=")[1].splitlines()[0]
    assert "serve.vx=[-5.7, -5.2]" in command_help("train", "serve=short")
    assert "Training serves" in text
    rubber = command_help("train", "ball")
    assert "ball.table.length=2.74" in rubber  # of the file that it takes over
    assert "_table" not in rubber


def test_options_of_hydra_may_stand_anywhere(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "evaluate", "runs/a", "--cfg", "job", "ball=paper", "serves=7") == 0
    printed = capsys.readouterr().out
    assert "serves: 7" in printed
    assert "- ball=paper" in printed


def test_help_may_stand_before_the_run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    texts = []
    for arguments in (("--help", "runs/a"), ("runs/a", "--help"), ("-h",)):
        assert run(monkeypatch, "evaluate", *arguments) == 0
        texts.append(capsys.readouterr().out)
    assert texts[0] == texts[1] == texts[2]


@pytest.mark.parametrize("group", COMMANDS["bench"].groups)
def test_every_choice_of_every_group_has_a_help(group: str) -> None:
    for choice in choices(group):
        text = command_help("bench", f"{group}={choice}")
        assert all(len(line) <= WIDTH for line in text.splitlines())


def test_comments_belong_to_their_keys(tmp_path: Path) -> None:
    (tmp_path / "_base.yaml").write_text("low: 1   # m\nother: 2\n")
    (tmp_path / "mine.yaml").write_text(
        "# What it is.\ndefaults: [_base]\nlow: 3\n\n# above\nhigh: 4.0e6  # s\n  # goes on\n"
        "inner:   # of both\n  a: [x,\n      y]   # two\n  b: {c: 1}\n"
        "list:  # items\n  - {d: 1}   # one\n  - e: [2]\n    f: 3\n"
    )
    keys = {key.name: (key.default, key.comment) for key in file_keys(tmp_path / "mine.yaml").values()}
    assert keys == {
        "low": ("3", "m"),
        "other": ("2", ""),
        "high": ("4.0e6", "above s goes on"),
        "inner.a": ("[x, y]", "two (of both)"),
        "inner.b": ("{c: 1}", ""),
        "list": ("[{d: 1}, {e: [2], f: 3}]", "items one"),
    }
    assert heading(tmp_path / "mine.yaml") == "What it is."


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("evalute",), "there is no command 'evalute'; did you mean evaluate? (train, evaluate, play,"),
        (("train", "num_world=512"), "there is no key 'num_world'; did you mean num_worlds?"),
        (("train", "algo.gama=0.9"), "there is no key 'algo.gama'; did you mean gamma?"),
        (("train", "+serve.speed=3"), "serve.speed"),
        (("train", "experiment=papper"), "experiment/papper does not exist; did you mean paper? (experiment: "),
        (("train", "ball=plastic"), "ball/plastic does not exist (ball: anti_spin, long_pimples, paper, rubber"),
        (("train", "engine=mjx"), "(engine: auto, mjwarp, native)"),
        (("train", "--minutes", "3"), "write minutes=3"),
        (("train", "--num_worlds=512"), "write num_worlds=512"),
        (("train", "minutes", "=", "3"), "write minutes=3, without spaces"),
        (("train", "minutes=", "3"), "write minutes=3, without spaces"),
        (("train", "minutes", "=3"), "write minutes=3, without spaces"),
        (("train", "minutes"), "'minutes' is no key=value"),
        (("train", "serve.vx=-5"), "'serve.vx': needs a list"),
        (("train", "plugins=my_module"), "write plugins=[my_module]"),
        (("train", "run_dir=runs/x"), "run_dir= is now out="),
        (("ablate", "run_dir=runs/x"), "run_dir= is now out="),
        (("ablate", "experiment=paper"), "experiments= names them"),
        (("evaluate", "policy=zero", "serve=short"), "rows= names the serve ranges"),
        (("evaluate", "policy=zero", "observation=memory"), "observation= is of pace train"),
        (("evaluate", "policy=zero", "serve.speed=3", "rows=[short]"), "speed"),
        (("evaluate", "policy=zero", "rows=[lob]"), "serve/lob does not exist (serve: long, machine, mid_long"),
        (("evaluate", "policy=zero", "row=[short]"), "did you mean rows?"),
        (("play", "a", "overrides=[ball=paper]"), "there is no key 'overrides'"),
        (("play", "a", "rows=[short]"), "there is no key 'rows'"),
        (("play", "a", "reward.scale=2"), "reward.scale= is no key of pace play: no reward is computed"),
        (("evaluate", "a", "reward.terms.fall.weight=2"), "no key of pace evaluate: no reward is computed"),
        (("play", "a", "--video"), "--video needs a value"),
        (("export", "a", "ball=paper"), "ball= is of pace train, and changes nothing in pace export"),
        (("bench", "samples=1e6"), "bench.train_updates"),
        (("bench", "resume=runs/x"), "resume= is of pace train"),
        (("predictor", "init_from=runs/x"), "init_from= is of pace train"),
        (("studies", "parities"), "there is no study 'parities'; did you mean parity?"),
        (("studies",), "which study? reaction, parity,"),
        (("studies", "--worlds", "3"), "write worlds=3"),
        (("keep", "runs/x"), "where to?"),
        (("train", "--help", "bal"), "pace train takes no group bal; did you mean ball?"),
        (("train", "--help", "ball=papr"), "did you mean paper?"),
    ],
)
def test_what_is_written_wrong_ends_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], arguments: tuple[str, ...], words: str
) -> None:
    assert words in error_line(monkeypatch, capfd, *arguments)


def test_a_renamed_choice_ends_in_one_line(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(RENAMED_CHOICES, "ball", {"old": "paper"})
    for group, renamed in RENAMED_CHOICES.items():
        command = "bench" if group == "bench" else "train"
        for old, new in renamed.items():
            words = f"{group}={old} is now {group}={new}"
            assert error_line(monkeypatch, capfd, command, f"{group}={old}") == words
    for command in ("play", "evaluate"):
        assert "ball=old is now ball=paper" in error_line(monkeypatch, capfd, command, "a", "ball=old")


def test_a_policy_that_is_not_there_names_those_that_are(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in ("evaluate", "play", "export"):
        assert run(monkeypatch, command, "pretrained/pase") == 1
        error = capsys.readouterr().err.splitlines()[-1]
        known = ", ".join(sorted(path.name for path in Path("pretrained").glob("*/")))
        assert error.endswith(f"pretrained/pase does not exist; did you mean pace? (pretrained: {known})")


@pytest.mark.parametrize("module", ["pace", "pace.rl.train"])
def test_ctrl_c_while_modules_are_imported_is_one_line(module: str) -> None:
    """Pressed as soon as the command line is being loaded; hydra and torch come after it."""
    code = (
        "import builtins, os, runpy, signal, sys\n"
        "usual = builtins.__import__\n"
        "def load(name, *rest, **named):\n"
        "    if name == 'hydra':\n"
        "        os.kill(os.getpid(), signal.SIGINT)\n"
        "    return usual(name, *rest, **named)\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "builtins.__import__ = load\nsys.argv = ['pace', 'train', 'x']\n"
        f"runpy.run_module({module!r}, run_name='__main__', alter_sys=True)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode in (-signal.SIGINT, 130)
    assert done.stderr == "error: interrupted\n"


def test_missing_packages_are_named_as_they_can_be_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    needed = ["torch>=2", "mjviser>=0.0.14; extra == 'viewer'", "onnx>=1 ; python_version>'3' and extra == \"export\""]
    monkeypatch.setattr("pace.config.extras.requires", lambda name: needed)
    assert cure("viewer") == "pip install 'mjviser>=0.0.14'"
    assert cure("export") == "pip install 'onnx>=1'"
    assert cure("wandb") == "pip install -e '.[wandb]'"  # of a checkout that was installed before there was one


def test_a_command_is_its_module(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[tuple[str, list[str]]] = []

    def run_module(module: str, **_: object) -> None:
        started.append((module, sys.argv[1:]))

    monkeypatch.setattr(runpy, "run_module", run_module)
    for name in COMMANDS:
        assert run(monkeypatch, name, "a", "b=1") == 0
    assert started == [(command.module, ["a", "b=1"]) for command in COMMANDS.values()]


@pytest.mark.parametrize("old", sorted(MOVED))
def test_old_commands_name_the_new_one(old: str) -> None:
    done = subprocess.run([sys.executable, "-m", old, "runs/x"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    lines = [line for line in done.stderr.splitlines() if not line.startswith("Warp")]
    assert lines == [f"error: python -m {old} is now: pace {MOVED[old]}"]
    assert MOVED[old] in COMMANDS
    with pytest.raises(ImportError, match=f"pace {MOVED[old]}"):
        __import__(old)


def test_pace_is_a_console_script() -> None:
    project = tomllib.loads(Path("pyproject.toml").read_text())["project"]
    assert project["scripts"] == {"pace": "pace.__main__:main"}


@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)
def test_work_and_failures_of_a_command_are_there(command: Command) -> None:
    assert callable(resolve_name(command.work))
    assert all(issubclass(resolve_name(path), Exception) for path in command.failures)


PATHS = (
    "my run", "Läufe/卓球 1.", "a=b, c", "it's", 'say "x"', "back\\slash", "end\\", "1e3", "true", "[x]", "{a: 1}",
    "~/x", "$x", "a#b", "%d", "(½)", ":x", "a  b", "\t", "Straße\u0301",
)  # fmt: skip


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("quoted", [False, True])
def test_a_path_arrives_as_it_is_written(path: str, quoted: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also in a worker, which is started with the arguments that Hydra got."""
    found: list[str] = []
    monkeypatch.setattr("pace.command.run.resolve_name", lambda _: lambda config: found.append(config.out))
    monkeypatch.setattr(sys, "argv", ["evaluate", "run", f"out={quote(path) if quoted else path}"])
    assert run_command("evaluate") == 0
    assert run_command("evaluate") == 0
    assert found == [path, path]


@pytest.mark.parametrize(("number", "status"), [(errno.ENOSPC, 1), (errno.EROFS, 1), (errno.EACCES, 1)])
def test_a_disk_that_cannot_be_written_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], number: int, status: int
) -> None:
    def work(config: object) -> None:
        raise OSError(number, os.strerror(number), "out/table.csv")

    monkeypatch.setattr("pace.command.run.resolve_name", lambda _: work)
    monkeypatch.setattr(sys, "argv", ["validate"])
    assert run_command("validate") == status
    assert capsys.readouterr().err == f"error: out/table.csv: {os.strerror(number)}\n"


def test_a_full_gpu_is_one_line_and_other_errors_stay(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    error = RuntimeError("Failed to allocate 4194304 bytes on device 'cuda:0'")

    def work(config: object) -> None:
        raise error

    monkeypatch.setattr("torch.cuda.mem_get_info", lambda _: (2**29, 8 * 2**30))
    monkeypatch.setattr("pace.command.run.resolve_name", lambda _: work)
    monkeypatch.setattr(sys, "argv", ["validate"])
    assert run_command("validate") == 1
    assert capsys.readouterr().err == (
        "error: the GPU's memory is full (8.0 GiB, 0.5 free): by estimate a training run of 8,704 worlds fits if "
        "nothing else runs there; give a smaller num_worlds\n"
    )
    error = RuntimeError("another")
    with pytest.raises(RuntimeError, match="another"):
        run_command("validate")


@pytest.mark.parametrize("code", [errno.ENOENT, errno.ENOTDIR, errno.ESTALE])
def test_a_folder_that_is_lost_under_a_command_is_one_line(
    code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def work(config: object) -> None:
        raise OSError(code, os.strerror(code), "runs/mine")

    monkeypatch.setattr("pace.command.run.resolve_name", lambda _: work)
    monkeypatch.setattr(sys, "argv", ["validate"])
    assert run_command("validate") == 1
    assert capsys.readouterr().err == f"error: runs/mine: {os.strerror(code)}\n"


def test_a_deleted_current_folder_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    monkeypatch.setattr(sys, "argv", ["validate"])
    assert run_command("validate") == 1
    assert capsys.readouterr().err == "error: the current folder was deleted: change to one that exists\n"


def test_a_terminated_command_has_its_own_status(monkeypatch: pytest.MonkeyPatch) -> None:
    def work(config: object) -> None:
        raise Terminated

    monkeypatch.setattr("pace.command.run.resolve_name", lambda _: work)
    monkeypatch.setattr(sys, "argv", ["validate"])
    assert run_command("validate") == 75
