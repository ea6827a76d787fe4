"""The node by itself: ros2 launch scenematch_ros node.launch.py map:=site.tif params:=my.yaml namespace:=uav1."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

DEFAULTS = {"surface": "", "camera": "", "start": "", "method": "auto", "firmware": "none", "origin": ""}


def generate_launch_description():
    """The arguments, and the node with its parameters: of the file, then of the arguments."""
    own = PathJoinSubstitution([FindPackageShare("scenematch_ros"), "config", "node.yaml"])
    text = {name: ParameterValue(LaunchConfiguration(name), value_type=str) for name in ("map", *DEFAULTS)}
    time = {"use_sim_time": ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)}
    return LaunchDescription(
        [
            DeclareLaunchArgument("map"),
            DeclareLaunchArgument("params", default_value=own),
            DeclareLaunchArgument("namespace", default_value=""),
            DeclareLaunchArgument("use_sim_time", default_value="false"),
            DeclareLaunchArgument(
                "pose", default_value="~/pose", description="/mavros/vision_pose/pose_cov to fly by"
            ),
            *(DeclareLaunchArgument(name, default_value=value) for name, value in DEFAULTS.items()),
            Node(
                package="scenematch_ros",
                executable="node",
                name="scenematch",
                namespace=LaunchConfiguration("namespace"),
                output="screen",
                parameters=[LaunchConfiguration("params"), text, time],
                remappings=[("~/pose", LaunchConfiguration("pose"))],
            ),
        ]
    )
