"""From a ROS bag to images and the joint values at their times, as board_poses.py reads them. Needs rosbags.

    python scripts/bag_joints.py run.bag images /camera/image_raw/compressed --joints /joint_states

Reads what rosbags reads; tried on bags of ROS 2. `images` becomes a folder with the images and joints.csv: `image`, and
a column for each joint [rad or m], interpolated between the joint states before and after the image by the times in the
headers. Only compressed images (sensor_msgs/CompressedImage) are read. Clocks of camera and robot are milliseconds
apart: images around which a joint moves by more than --still within 0.2 s are left out, as are those outside the joint
states, and counted.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

AROUND = (-0.1, -0.05, 0.0, 0.05, 0.1)
"""Times around an image at which the joints are compared, s."""


def seconds(stamp: Any) -> float:
    """Time of a header."""
    return stamp.sec + 1e-9 * stamp.nanosec


def read(bag: Path, topic: str, joints: str) -> tuple[list[tuple[float, bytes]], np.ndarray, list[str]]:
    """Images with their times [s], joint states (N, 1 + n) with theirs first, sorted, and the names of the n joints."""
    import numpy as np  # noqa: PLC0415  # --help needs none of these
    from rosbags.highlevel import AnyReader  # pyright: ignore[reportMissingImports]  # noqa: PLC0415
    from rosbags.typesys import Stores, get_typestore  # pyright: ignore[reportMissingImports]  # noqa: PLC0415

    images, states, names = [], [], []
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        wanted = [connection for connection in reader.connections if connection.topic in (topic, joints)]
        for connection, _, raw in reader.messages(connections=wanted):
            message: Any = reader.deserialize(raw, connection.msgtype)
            time = seconds(message.header.stamp)
            if connection.topic == topic:
                images.append((time, bytes(message.data)))
                continue
            names, other = names or list(message.name), list(message.name)
            if names != other:
                raise SystemExit(f"{joints}: joint states of {names} and of {other}: name the topic of one robot")
            states.append([time, *message.position])
    if not images or not states:
        raise SystemExit(f"{bag}: {len(images)} images of {topic}, {len(states)} states of {joints}")
    return images, np.array(sorted(states)), names


def main() -> None:
    """Read both topics, write what belongs together."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("topic", help="of the compressed images")
    parser.add_argument("--joints", default="/joint_states", metavar="TOPIC")
    parser.add_argument("--still", type=float, default=1e-3, help="largest motion of a joint, rad or m")
    given = parser.parse_args()
    import numpy as np  # noqa: PLC0415

    images, states, names = read(given.bag, given.topic, given.joints)
    known, counts = states[:, 0], {"moving": 0, "outside": 0}
    given.folder.mkdir(parents=True, exist_ok=True)
    with (given.folder / "joints.csv").open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["image", *names])
        for number, (time, content) in enumerate(images):
            near = np.stack([np.interp(np.add(time, AROUND), known, column) for column in states[:, 1:].T], axis=1)
            if not known[0] <= time <= known[-1]:
                counts["outside"] += 1
            elif np.ptp(near, axis=0).max() > given.still:
                counts["moving"] += 1
            else:
                name = f"{number:05d}" + (".png" if content[:4] == b"\x89PNG" else ".jpg")
                (given.folder / name).write_bytes(content)
                rows.writerow([name, *near[len(AROUND) // 2].tolist()])
    left = f"{counts['moving']} while the robot moved, {counts['outside']} outside the joint states"
    print(f"{len(images) - sum(counts.values())} of {len(images)} images; left out: {left}")


if __name__ == "__main__":
    main()
