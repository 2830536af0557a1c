"""Settings from files: every value reaches its place, and a mistake is told with the file and the key."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from fieldpose.deploy.settings import Settings, changed, read_file, read_settings, to_json, without_unknown
from fieldpose.errors import ConfigError
from fieldpose.stages.geometry import Limit


def written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_a_toml_file_changes_what_it_names_and_nothing_else(tmp_path: Path) -> None:
    path = written(tmp_path / "a.toml", '[matching]\nmatcher = "sift"\n[tracking.motion]\nwindow_ms = 80\n')
    settings = read_settings(path)
    assert settings.matching.matcher == "sift"
    assert settings.tracking.motion.window_ms == 80
    assert settings.pnp == Settings().pnp
    assert settings.tracking.score == Settings().tracking.score


def test_json_is_read_by_its_name(tmp_path: Path) -> None:
    path = written(tmp_path / "a.json", json.dumps({"matching": {"weights": "w.pt"}, "camera": {"source": "camera:0"}}))
    settings = read_settings(path)
    assert settings.matching.weights == Path("w.pt")
    assert settings.camera.source == "camera:0"


def test_all_settings_survive_being_written_and_read(tmp_path: Path) -> None:
    changes = {
        "address": {"site": "lab"},
        "camera": {"source": "folder:x", "camera_file": "c.json", "progress_file": "p"},
        "tracking": {"guess": "train:a", "score": {"usable": 0.3}},
        "refinement": {"steps": 0},
    }
    settings = changed(Settings(), changes, "here")
    path = tmp_path / "settings.json"
    path.write_bytes(to_json(settings))
    assert read_settings(path) == settings


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[matchin]\n", ("unknown setting 'matchin'", "did you mean matching")),
        ("[matching]\nmatchr = 'sift'\n", ("unknown setting 'matching.matchr'", "did you mean matching.matcher")),
        ("[pnp]\nzzzz = 1\n", ("unknown setting 'pnp.zzzz'", "there are pnp.threshold_px")),
        ("[pnp]\nseed = 'x'\n", ("pnp.seed", "expected `int`", "'x'")),
        ("[pnp]\nseed = 1.5\n", ("pnp.seed", "expected `int`", "1.5")),
        ("[tracking]\nsequence = 'film'\n", ("tracking.sequence", "'film'")),
        ("tracking = 3\n", ("tracking", "expected a table", "3")),
        ("[tracking]\ndepth = 0\n", ("depth is 0", "at least 1")),
        ("[tracking\n", ("not a TOML file",)),
    ],
)
def test_a_mistake_is_told_in_one_line_with_file_and_key(tmp_path: Path, text: str, said: tuple[str, ...]) -> None:
    path = written(tmp_path / "bad.toml", text)
    with pytest.raises(ConfigError) as raised:
        read_settings(path)
    message = str(raised.value)
    assert "\n" not in message
    for part in (str(path), *said):
        assert part in message


def test_files_that_are_not_there_or_hold_no_table_are_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such configuration file"):
        read_file(tmp_path / "none.toml")
    with pytest.raises(ConfigError, match="expected tables of settings, got a list"):
        read_file(written(tmp_path / "a.json", "[1]"))
    with pytest.raises(ConfigError, match="not a JSON file"):
        read_file(written(tmp_path / "b.json", "{"))


def test_what_a_version_no_longer_has_is_left_out_and_named() -> None:
    content: dict[str, Any] = {
        "tracking": {"jump_per_s": 1.0, "depth": 3, "settled_deg": 2.0, "settled": 0.01, "motion": {"inertia": 1}},
        "smoothing": {},
    }
    left_out = {"smoothing", "tracking.jump_per_s", "tracking.motion.inertia"}
    assert set(without_unknown(Settings(), content)) == left_out
    tracking = changed(Settings(), content, "test").tracking
    assert (tracking.depth, tracking.settled) == (3, Limit(2.0, 0.01))
