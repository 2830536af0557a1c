"""The pose of one image in a trained field: python examples/estimate_one_image.py FIELD IMAGE"""

import sys

import numpy as np

import fieldpose


def main(field: str, image: str) -> int:
    with fieldpose.PoseFinder(field) as finder:
        found = finder.find(image)
    if found.cam_from_object is None:
        print(f"no pose: {found.reason}")
        return 1
    np.set_printoptions(precision=4, suppress=True)
    print(found.cam_from_object)
    centre = -found.cam_from_object[:3, :3].T @ found.cam_from_object[:3, 3]
    print(f"the camera is at {centre} in the object's frame; {found.state}, score {found.score:.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]) if len(sys.argv) == 3 else __doc__)
