"""Start a camera and our node: `ros2 launch s2a_bench s2a_bench.launch.py engine:=echo camera:=test`."""  # noqa: INP001

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, Shutdown
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.actions import Node
from launch_ros.substitutions import ExecutableInPackage

ARGUMENTS = {
    "camera": ("v4l2", "v4l2: a camera by v4l2_camera; test: moving pictures of image_tools; none: one runs already"),
    "device": ("/dev/video0", "the camera of camera:=v4l2"),
    "namespace": ("/llama", "where our node answers; frames come on <namespace>/camera/image_raw"),
    "node_name": ("server", "name of our node, below the namespace"),
    "engine": ("llama", "llama or echo"),
    "params_file": ("", "a file of parameters, as every ROS 2 node takes it"),
    "arguments": ("", "more for `s2a-bench serve ros`, as one string"),
}


def _flag(name: str) -> str:
    """Return how our command line spells an argument."""
    return f" --{name.replace('_', '-')} "


def _if_camera(name: str) -> IfCondition:
    """Make the condition camera:=name, in a way that Humble and Jazzy share."""
    return IfCondition(PythonExpression(["'", LaunchConfiguration("camera"), f"' == '{name}'"]))


def generate_launch_description() -> LaunchDescription:
    """Describe the camera and the node; when the node ends, so does the camera."""
    value = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    image_topic = [value["namespace"], "/camera/image_raw"]
    v4l2 = Node(
        package="v4l2_camera",
        executable="v4l2_camera_node",
        parameters=[
            {
                "video_device": value["device"],
                "pixel_format": "YUYV",
                "output_encoding": "yuv422_yuy2",
                "image_size": [640, 480],
            }
        ],
        remappings=[("image_raw", image_topic)],
        condition=_if_camera("v4l2"),
    )
    test = Node(
        package="image_tools",
        executable="cam2image",
        parameters=[{"burger_mode": True, "width": 640, "height": 480, "frequency": 30.0}],
        remappings=[("image", image_topic)],
        condition=_if_camera("test"),
    )
    # no Node: its arguments are a list, and `arguments` is one string, which the shell splits
    program = ExecutableInPackage("s2a-bench", "s2a_bench")
    flags = [piece for name in ("namespace", "node_name", "engine") for piece in (_flag(name), value[name])]
    file = value["params_file"]
    ros_args = PythonExpression(["'--ros-args --params-file \"", file, "\"' if '", file, "' else ''"])
    node = ExecuteProcess(  # noqa: S604 - the user's own words
        cmd=[["exec ", program, " serve ros", *flags, " ", value["arguments"], " ", ros_args]],
        name="s2a_bench",
        shell=True,
        output="screen",
        on_exit=Shutdown(),
    )
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, v4l2, test, node])
