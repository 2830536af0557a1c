"""Who may do what on the bus, from the rows of the graph, and for those who are around it."""

from __future__ import annotations

from fieldpose.bus.access import Role
from fieldpose.bus.topics import ALL, PRIOR
from fieldpose.deploy.graph import BY_NAME, CAMERA, GRAPH, HUB, OBSERVER, RECORDER
from fieldpose.errors import UsageError

VIEWER, OPERATOR, PRIOR_SOURCE, PROGRAM = "viewer", "operator", "prior", "program"

_AROUND = {
    VIEWER: "sees everything: top, view, bridge foxglove",
    OPERATOR: "sees everything, and asks tracking: control, the buttons of view",
    PRIOR_SOURCE: "sees everything, and sends guesses of frames' poses",
    PROGRAM: "one's own program, and bridge ros2: sees everything, sends frames and guesses, asks tracking",
}


def roles() -> tuple[Role, ...]:
    """All roles: the hub, a role for each process of the graph, of its name, and those of who stands around it."""
    camera = BY_NAME[CAMERA].writes
    return (
        Role(HUB, passes_on=True),
        *(Role(row.name, row.reads, row.writes, answers=True) for row in GRAPH if row.name != HUB),
        Role(OBSERVER, ALL),
        Role(VIEWER, ALL),
        Role(OPERATOR, ALL, asks=True),
        Role(PRIOR_SOURCE, ALL, (PRIOR,)),
        Role(PROGRAM, ALL, (*camera, PRIOR), asks=True),
    )


def role_named(name: str) -> Role:
    """A role by its name. Raises UsageError that lists them."""
    found = next((role for role in roles() if role.name == name), None)
    if found is None:
        raise UsageError(f"no role {name!r}; expected one of {', '.join(role.name for role in roles())}")
    return found


def in_words(role: Role) -> str:
    """What a role is for."""
    if role.name in _AROUND:
        return _AROUND[role.name]
    if role.name == HUB:
        return "stage hub"
    if role.name == OBSERVER:
        return "the command `run` itself: sees everything"
    also = ", record" if role.name == RECORDER else ""
    return f"stage {role.name}{also}"
