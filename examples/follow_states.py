"""Where a running pipeline believes the camera to be: python examples/follow_states.py [HUB]

Start the pipeline first, for instance: fieldpose run FIELD --source camera:0 --listen tcp/127.0.0.1:7447
"""

import sys

import numpy as np

import fieldpose


def main(hub: str = "tcp/127.0.0.1:7447", patience_s: str = "30") -> int:
    with fieldpose.connect(hub) as pipeline:
        print(f"following the pipeline at {hub}", flush=True)
        for state in pipeline.states(timeout_s=float(patience_s)):
            if state.cam_from_object is None:
                print(f"frame {state.header.frame_id}: {state.state}, no pose: {state.reason}", flush=True)
                continue
            position = -state.cam_from_object[:3, :3].T @ state.cam_from_object[:3, 3]
            told = np.array2string(position, precision=3)
            print(
                f"frame {state.header.frame_id}: {state.state}, score {state.score:.2f}, camera at {told}", flush=True
            )
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
