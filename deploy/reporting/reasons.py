"""Why there is no pose, or none that is sure, for people."""

from __future__ import annotations

from fieldpose.bus.messages import Reason

_WHY: dict[str, str] = {
    Reason.FRAME_UNREADABLE: "the image cannot be decoded",
    Reason.NOTHING_ALIKE: "no training view looks like the frame",
    Reason.NOTHING_IN_VIEW: "the field is not in view from where the camera was looked for",
    Reason.TOO_FEW_MATCHES: "field and frame show too little that is alike",
    Reason.TOO_FEW_CONSISTENT_POINTS: "too few of the matches are on a surface",
    Reason.NO_CONSENSUS: "what was matched does not agree on a pose",
    Reason.IMPLAUSIBLE_POSE: "the pose that was found is not near what was shown",
    Reason.CAMERA_DIFFERS: "the focal length is not as it is said to be",
    Reason.NO_ANSWER: "no stage has answered in time",
    Reason.RESET: "tracking was reset",
}
"""In words; the others say it themselves."""


def reason_in_words(reason: str) -> str:
    """What a Reason means, by its value."""
    return _WHY.get(reason, reason.replace("_", " "))
