"""A running pipeline within other systems."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from fieldpose.deploy.commands.bridge_foxglove import Foxglove
from fieldpose.deploy.commands.bridge_ros2 import Ros2


@dataclass(frozen=True)
class Options:
    """Take a pipeline that is running into another system: a node of ROS 2, or live into Foxglove.

    Example: fieldpose bridge foxglove --connect tcp/127.0.0.1:7447
    """

    to: tyro.conf.OmitSubcommandPrefixes[
        Annotated[Ros2, tyro.conf.subcommand("ros2")] | Annotated[Foxglove, tyro.conf.subcommand("foxglove")]
    ]

    def run(self) -> int:
        """Carry messages until a signal to stop."""
        return self.to.run()
