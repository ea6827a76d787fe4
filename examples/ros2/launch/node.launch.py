"""The node alone: ros2 launch scenematch_ros node.launch.py map:=site.tif params:=my.yaml namespace:=uav1."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

NAMES = ("map", "surface", "camera", "start", "method", "firmware", "origin")


def node(context):
    """The node with the file's parameters, overridden by the given arguments."""
    given = {name: LaunchConfiguration(name).perform(context) for name in NAMES}
    text = {name: value for name, value in given.items() if value}
    time = {"use_sim_time": LaunchConfiguration("use_sim_time").perform(context) == "true"}
    return [
        Node(
            package="scenematch_ros",
            executable="node",
            name="scenematch",
            namespace=LaunchConfiguration("namespace"),
            output="screen",
            parameters=[LaunchConfiguration("params"), text, time],
            remappings=[("~/pose", LaunchConfiguration("pose"))],
        )
    ]


def generate_launch_description():
    """The arguments, and the node."""
    own = PathJoinSubstitution([FindPackageShare("scenematch_ros"), "config", "node.yaml"])
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(name, default_value="") for name in NAMES),
            DeclareLaunchArgument("params", default_value=own),
            DeclareLaunchArgument("namespace", default_value=""),
            DeclareLaunchArgument("use_sim_time", default_value="false"),
            DeclareLaunchArgument(
                "pose", default_value="~/pose", description="/mavros/vision_pose/pose_cov to fly by"
            ),
            OpaqueFunction(function=node),
        ]
    )
