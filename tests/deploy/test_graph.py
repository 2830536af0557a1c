"""The graph: its rows say what the handlers say of themselves, and leave no topic without a sender or a reader."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import pytest

from fieldpose.bus.topics import ALL, CONTROL, FOLLOWED, PRIOR, STATS
from fieldpose.deploy.graph import AT_WORK, BY_NAME, GRAPH, HUB, RECORDER, STAGES, Launch, rows_of
from fieldpose.deploy.parts import Parts
from fieldpose.deploy.plan import resolve
from fieldpose.deploy.settings import Settings, changed

DOCS = Path(__file__).resolve().parents[2] / "docs"
PLANS: list[dict[str, Any]] = [
    {"tracking": {"sequence": "photos"}},
    {"tracking": {"sequence": "video"}},
    {"tracking": {"guess": "perturb:10-40deg,0.2"}, "pnp": {"align_levels": 0}, "lifting": {"views": 0}},
]


@pytest.mark.parametrize("changes", PLANS)
@pytest.mark.parametrize("name", STAGES)
def test_a_handler_reads_and_writes_what_its_row_says(name: str, changes: dict[str, Any]) -> None:
    row, parts = BY_NAME[name], Parts(resolve(changed(Settings(), changes, "test"), None))
    assert row.make is not None
    handler = row.make(parts, Launch())
    assert handler.name == name
    assert set(handler.outputs) == set(row.writes)
    assert set(handler.inputs) <= set(row.reads)


def test_among_all_plans_it_reads_all_of_that() -> None:
    everything = [Parts(resolve(changed(Settings(), changes, "test"), None)) for changes in PLANS]
    for row in GRAPH:
        if row.writes and row.make is not None:
            read = {topic for parts in everything for topic in row.make(parts, Launch()).inputs}
            assert read == set(row.reads)


def test_every_topic_has_who_writes_and_who_reads_it() -> None:
    written = {topic for row in GRAPH for topic in row.writes}
    read = {topic for row in GRAPH if row.name != RECORDER for topic in row.reads}
    assert written == set(ALL) - {STATS}
    assert read == written - {FOLLOWED, CONTROL}, "which are for people and recordings"
    assert set(BY_NAME[RECORDER].reads) == set(ALL)
    assert [row.name for row in GRAPH if PRIOR in row.writes] == ["perturbation"]


def test_a_plan_has_the_processes_that_it_has_work_for() -> None:
    def names(changes: dict[str, Any], recorded: bool = False) -> set[str]:
        return {row.name for row in rows_of(resolve(changed(Settings(), changes, "test"), None), recorded)}

    usual = set(BY_NAME) - {RECORDER, "perturbation"}
    assert names({}) == usual
    assert names({}, recorded=True) == usual | {RECORDER}
    assert names({"retrieval": {"candidates": 0}}) == usual - {"retrieval"}
    assert names(PLANS[2]) == usual | {"perturbation"}
    assert set(AT_WORK) == usual - {HUB, "camera"}


def test_the_picture_shows_every_edge_as_it_is() -> None:
    picture = runpy.run_path(str(DOCS / "dataflow.py"))
    drawn = picture["draw"]()
    assert drawn == (DOCS / "dataflow.svg").read_text(encoding="utf-8")
    for name in STAGES:
        assert f">{name}</text>" in drawn
    edges = {
        (sender.name, reader.name, topic.name)
        for sender in GRAPH for topic in sender.writes for reader in GRAPH
        if topic in reader.reads and reader.name != RECORDER
    }  # fmt: skip
    assert edges == set(picture["edges"]())
    for topic in {topic for _, _, topic in edges}:
        assert f">{topic}</text>" in drawn


def test_topics_name_their_writers_as_the_graph_has_them() -> None:
    for topic in ALL:
        assert set(topic.writers) == {row.name for row in GRAPH if topic in row.writes}
