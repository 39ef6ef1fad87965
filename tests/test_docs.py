"""The pages for readers: each name of the package and each relative link on them exists, and the picture is current."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest
from PIL import Image

import pace
from pace.command.table import COMMANDS, TRAIN_GROUPS
from pace.config.names import choices
from pace.moved import MOVED
from pace.studies import architecture

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
NAME = re.compile(r"\bpace(?:\.\w+)+")
ENTRY_POINTS = {"pace.reward_terms", "pace.observations", "pace.critic_observations", "pace.algorithms", "pace.engines"}
NOT_NAMES = ENTRY_POINTS | {"pace.predictors"}


def resolve(name: str) -> bool:
    """Whether a dotted name is a module, or an attribute of one or of a class."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            annotated = getattr(found, "__annotations__", {})
            if not hasattr(found, part):
                return part in annotated
            found = getattr(found, part)
        return True
    return False


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub makes them."""
    titles = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_names_of_the_package_exist(page: Path) -> None:
    names = {name for name in NAME.findall(page.read_text()) if name not in NOT_NAMES}
    assert [name for name in sorted(names) if name in MOVED or not resolve(name)] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_relative_links_exist(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if "://" in link:
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_exist(page: Path) -> None:
    named = re.findall(r"(?:`|^)pace ([a-z]\w+)\b", page.read_text(), re.MULTILINE)
    assert [name for name in named if name not in COMMANDS] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_paths_of_files_exist(page: Path) -> None:
    named = re.findall(r"`((?:pace|configs|docs|tests|examples|pretrained)/[\w/.]*)`", page.read_text())
    new = ("lob.yaml", "heavy.yaml")  # files that a recipe makes
    assert [path for path in named if not (ROOT / path).exists() and not path.endswith(new)] == []


def test_the_picture_shows_the_imports_of_today() -> None:
    """Otherwise: ``pace studies architecture out=docs``."""
    with Image.open(ROOT / "docs" / "architecture.png") as picture:
        assert picture.info["Description"] == architecture.described(architecture.read_rooms())
        assert picture.width == 900


def test_arrows_leave_out_what_follows_from_others() -> None:
    def room(name: str, *imports: str) -> architecture.Room:
        return architecture.Room(name, "A room.", (), frozenset(imports))

    rooms = {"a": room("a"), "b": room("b", "a"), "c": room("c", "a", "b")}
    assert architecture.arrows(rooms) == [("b", "a"), ("c", "b")]
    assert architecture.levels(rooms) == {"a": 0, "b": 1, "c": 2}
    assert architecture.arrange(rooms) == [("a",), ("b",), ("c",)]


def test_the_port_tables_are_those_of_the_exported_file() -> None:
    from pace.deploy.graph import readings, results

    text = (ROOT / "docs" / "robot.md").read_text()
    rows = {name: (size, unit) for name, size, unit in re.findall(r"^\| `(\w+)` \| (\w+) \| ([^|]+) \|", text, re.M)}
    for name, port in (readings(21) | results(21)).items():
        assert rows[name] == ("J" if port.size == 21 else str(port.size), port.unit)
    assert rows["state"] == rows["state_next"] == ("S", "-")


def test_the_readme_fits_and_lists_the_commands() -> None:
    text = (ROOT / "README.md").read_text()
    assert [name for name in COMMANDS if f"| `pace {name}" not in text] == []
    assert len(text.splitlines()) <= 120
    assert text.split("```")[1].split()[:2] == ["make", "train"]


def test_the_page_on_architecture_lists_the_folders() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text()
    rooms = [name for name, room in architecture.read_rooms().items() if (ROOT / "pace" / name).is_dir()]
    assert [name for name in rooms if f"`pace/{name}/`" not in text] == []


def test_the_page_on_configuration_lists_the_groups() -> None:
    text = (ROOT / "docs" / "howto" / "configure.md").read_text()
    for group in TRAIN_GROUPS:
        listed = re.search(rf"^\| `{group}` \| ([^|]+) \|", text, re.MULTILINE)
        assert listed, group
        named = listed[1].strip().removesuffix(", ...").split(", ")
        assert set(named) <= set(choices(group)), group
        assert "..." in listed[1] or set(named) == set(choices(group)), group


def test_the_moving_picture_is_small_and_moves() -> None:
    file = ROOT / "docs" / "results" / "figures" / "campaign.webp"
    assert file.stat().st_size < 3e6
    with Image.open(file) as picture:
        assert picture.n_frames > 50  # type: ignore[attr-defined]


def test_the_version_is_that_of_the_changelog_and_the_citation() -> None:
    assert f"\n## {pace.__version__}\n" in (ROOT / "CHANGELOG.md").read_text()
    assert f"\nversion: {pace.__version__}\n" in (ROOT / "CITATION.cff").read_text()
