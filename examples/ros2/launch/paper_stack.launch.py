"""Gazebo Harmonic with the map, ArduPilot's IRIS, MAVROS, the truth and the node; start SITL separately.

ros2 launch scenematch_ros paper_stack.launch.py map:=site.tif origin:=LAT,LON [vehicle:=false for PX4's own]
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.conditions import IfCondition
from launch.launch_description_sources import AnyLaunchDescriptionSource, PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def share(package, *names):
    """A file of a package."""
    return PathJoinSubstitution([FindPackageShare(package), *names])


def generate_launch_description():
    """The simulator, its bridge, the vehicle, MAVROS, the truth and the node."""
    value = LaunchConfiguration
    simulated = {"use_sim_time": True}
    passed = {name: value(name) for name in ("map", "surface", "method", "start", "origin", "camera", "pose")}
    return LaunchDescription(
        [
            DeclareLaunchArgument("map"),
            DeclareLaunchArgument("origin"),
            *(DeclareLaunchArgument(name, default_value="") for name in ("surface", "start", "camera")),
            DeclareLaunchArgument("method", default_value="auto"),
            DeclareLaunchArgument("vehicle", default_value="true"),
            DeclareLaunchArgument("pose", default_value="~/pose"),
            DeclareLaunchArgument("mavros", default_value="apm.launch", description="px4.launch for PX4"),
            DeclareLaunchArgument("firmware", default_value="ardupilot"),
            DeclareLaunchArgument("fcu_url", default_value="tcp://127.0.0.1:5762"),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(share("ros_gz_sim", "launch", "gz_sim.launch.py")),
                launch_arguments={"gz_args": ["-r ", share("scenematch_ros", "worlds", "paper.sdf")]}.items(),
            ),
            Node(
                package="ros_gz_bridge",
                executable="parameter_bridge",
                parameters=[{"config_file": share("scenematch_ros", "config", "bridge.yaml")}, simulated],
            ),
            Node(
                condition=IfCondition(value("vehicle")),
                package="ros_gz_sim",
                executable="create",
                # The nose points north: along y, since the world is east-north-up.
                arguments=["-file", "model://iris_with_nadir_camera", "-z", "0.2", "-Y", "1.5707963267948966"],
            ),
            IncludeLaunchDescription(
                AnyLaunchDescriptionSource([share("mavros", "launch"), "/", value("mavros")]),
                launch_arguments={"fcu_url": value("fcu_url")}.items(),
            ),
            Node(
                package="scenematch_ros",
                executable="truth",
                parameters=[{"origin": value("origin")}, simulated],
            ),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(share("scenematch_ros", "launch", "node.launch.py")),
                launch_arguments={**passed, "firmware": value("firmware"), "use_sim_time": "true"}.items(),
            ),
        ]
    )
