"""The camera of a model in files of other programs: intrinsics, hand-eye transform, URDF joint, static transform."""

from __future__ import annotations

from xml.sax.saxutils import quoteattr

from diffeo_calib.cameras.files import camera_text, matrix_lines
from diffeo_calib.common.errors import InputError
from diffeo_calib.interop.tables import origin_numbers
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.hand_eye import HandEye
from diffeo_calib.measurements.poses import rotation_numbers
from diffeo_calib.robots.geometry import Geometry

FRAME = "_optical_frame"  # a camera's frame, behind its name: x right, y down, z ahead (REP 103)


def camera_files(
    model: CalibratedKinematics, geometry: Geometry | None = None, *, on_tool: bool | None = None
) -> dict[str, str]:
    """Names and contents of the files; those of several cameras begin with the camera's name.

    Args:
        model: of images of a board, or of its poses, which tell no lens. geometry: rigid kinematics that the camera's
            place belongs to; the model's own by default. on_tool: whether the camera is on the tool; needed
            where poses of the board were measured.

    Raises InputError: a model without such a camera, or one that was registered again.
    """
    cameras = {name: camera for each in model.placement for name, camera in each.cameras.items()}
    if not cameras and (model.lever is None or on_tool is None):
        fix = "calibrate with a table of `images`; of poses of a board say whether the camera is on the tool"
        raise InputError.of("the camera of the model", expected="one that saw a board", got="none", fix=fix)
    on_tool = bool(next(iter(cameras.values())).on_tool if cameras else on_tool)
    texts, each = dict[str, str](), HandEye.of_each(model, camera_on_tool=on_tool, geometry=geometry)
    for name, camera in each.items():
        prefix, files = name.replace("/", "_"), dict[str, str]()
        if cameras:
            lens = cameras[name.partition("/")[0] if name not in cameras else name].camera
            files = {"camera.yaml": camera_text(lens), "camera_info.yaml": camera_text(lens, ros=True)}
        files |= {"hand_eye.yaml": _hand_eye(camera)} | _of_ros(camera, prefix, model.geometry.on[0], on_tool=on_tool)
        texts |= {file if len(each) == 1 else f"{prefix}_{file}": text for file, text in files.items()}
    return texts


def _hand_eye(hand_eye: HandEye) -> str:
    """Camera and board as OpenCV's `FileStorage` reads them: R, t as of `calibrateHandEye`."""
    lines = ["%YAML:1.0", "---", f'camera_parent: "{hand_eye.camera.link}"']
    for name, fixed in vars(hand_eye).items():
        R, t = fixed.pose[:3, :3], fixed.pose[:3, 3]
        for part, rows, values in (("R", 3, R), ("t", 3, t), ("covariance", 6, fixed.covariance)):  # of shift, turn
            lines += matrix_lines(f"{name}_{part}", rows, values.flatten().tolist())
    return "\n".join([*lines, ""])


def _of_ros(hand_eye: HandEye, name: str, tip: str, *, on_tool: bool) -> dict[str, str]:
    """A calibration of easy_handeye2, a link and joint for xacro, a launch file of ROS 2 that publishes the frame."""
    frame, parent, shift = f"{name}{FRAME}", hand_eye.camera.link, hand_eye.camera.pose[:3, 3].tolist()
    turn = rotation_numbers(hand_eye.camera.pose[None, :3, :3], "quat_xyzw")[0].tolist()
    translation, quaternion = (
        "\n".join(f"    {axis}: {value!r}" for axis, value in zip(axes, numbers, strict=True))
        for axes, numbers in (("xyz", shift), ("xyzw", turn))
    )
    named = zip(("x", "y", "z", "qx", "qy", "qz", "qw"), [*shift, *turn], strict=True)
    words = [f"--{entry} {value!r}" for entry, value in named]
    words += [f"--frame-id {parent}", f"--child-frame-id {frame}"]
    xyz, rpy = (" ".join(map(repr, part)) for part in origin_numbers(hand_eye.camera.pose))
    return {
        "easy_handeye2.calib": f"""parameters:
  name: "{name}"
  calibration_type: "{"eye_in_hand" if on_tool else "eye_on_base"}"
  robot_base_frame: "{hand_eye.board.link if on_tool else parent}"
  robot_effector_frame: "{tip}"
  tracking_base_frame: "{frame}"
  tracking_marker_frame: "board"
  freehand_robot_movement: false
transform:
  translation:
{translation}
  rotation:
{quaternion}
""",
        "camera.xacro": f"""<?xml version="1.0"?>
<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
  <link name={quoteattr(frame)}/>
  <joint name={quoteattr(f"{name}_joint")} type="fixed">
    <parent link={quoteattr(parent)}/>
    <child link={quoteattr(frame)}/>
    <origin xyz="{xyz}" rpy="{rpy}"/>
  </joint>
</robot>
""",
        "static_transform.launch.xml": f"""<launch>
  <node pkg="tf2_ros" exec="static_transform_publisher" name="camera_transform" args={quoteattr(" ".join(words))}/>
</launch>
""",
    }
