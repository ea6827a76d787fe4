"""The commands of `bridge`."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from engine.errors import OptionError
from scenematch.cli import console, options
from scenematch.cli.options import EXPERT, INPUT, MAP, OUTPUT, flag, option, table, with_options

if TYPE_CHECKING:
    from scenematch.runs.bridge_files import BridgeFiles
    from scenematch.runs.map_input import MapInput
    from scenematch.runs.mavlink_bridge import BridgeSettings, MavlinkSettings
    from scenematch.runs.settings import Settings


@dataclass(frozen=True, kw_only=True)
class OptionalMapOptions:
    """The map, needed only to send fixes.

    Attributes:
        map: GeoTIFF, or a picture with a world file.
    """

    map: Annotated[Path | None, option("--map", "FILE", MAP)] = None
    surface: options.SurfaceOption = None

    def map_input(self, settings: Settings) -> MapInput:
        """The map combined with its settings."""
        if self.map is None:
            raise OptionError("map: expected a file, got none")
        return options.MapOptions(map=self.map, surface=self.surface).map_input(settings)


@dataclass(frozen=True, kw_only=True)
class PictureOptions(options.CameraOptions):
    """The camera, or recorded pictures.

    Attributes:
        frames: Recorded pictures, replayed in real time.
        telemetry: telemetry.csv or a log that times the replay (default: .SRT, EXIF or the video's own times).
        camera_source: A camera, a stream, or a command that writes JPEGs.
    """

    frames: Annotated[Path | None, option("--frames", "DIR|VIDEO", INPUT)] = None
    telemetry: Annotated[Path | None, option("--telemetry", "FILE", INPUT)] = None
    camera_source: Annotated[str | None, option("--camera-source", "N|URL|exec:CMD", INPUT)] = None

    def files(self, site: OptionalMapOptions, settings: Settings) -> BridgeFiles:
        """The map and the pictures combined with their settings."""
        from scenematch.runs.bridge_files import BridgeFiles

        return BridgeFiles(
            map=site.map_input(settings),
            camera=self.camera_input(settings),
            frames=self.frames,
            telemetry=self.telemetry,
            camera_source=self.camera_source,
            **table(settings, "input").of(BridgeFiles),
        )


def _bridge_settings(matching: options.MatchingOptions, settings: Settings) -> BridgeSettings:
    """How a bridge matches frames: the options combined with the settings."""
    how = matching.track_settings(settings)
    same = {each.name: getattr(how, each.name) for each in fields(how)}
    made: BridgeSettings = table(settings, "bridge", **same)
    return made


@with_options
def mavlink(
    *,
    connect: Annotated[str | None, option("--connect", "LINK", INPUT)] = None,
    firmware: Annotated[str | None, option("--firmware", "ardupilot|px4", INPUT)] = None,
    pictures: PictureOptions,
    matching: options.MatchingOptions,
    site: OptionalMapOptions,
    out: Annotated[Path | None, option("--write-params", "FILE", OUTPUT)] = None,
    measure_delay: Annotated[bool, flag("--measure-delay", OUTPUT)] = False,
    supervise: Annotated[bool, flag("--supervise", EXPERT)] = False,
    settings: options.SettingsOption = None,
    rerun: options.RerunOption = None,
    force: options.ForceOption = False,
) -> None:
    """Send fixes to an autopilot by MAVLink.

    Reads attitude, height and velocity from the autopilot, matches pictures from a camera or a recording, and
    sends fixes until the pictures end. --write-params only writes the parameter file with which ArduPilot or PX4
    uses these fixes. --measure-delay measures the camera's latency: tilt the vehicle to and fro by hand while it
    compares the rotation in the pictures with the autopilot's attitude.

    Options:
        connect: udpin:HOST:PORT, udp:PORT, udpout:HOST:PORT, tcp:HOST:PORT, serial:DEVICE:BAUD.
        firmware: Firmware of the autopilot (default: ardupilot).
        out: Write the autopilot's parameters for these fixes, then exit.
        measure_delay: Measure the camera's latency, then exit.
        supervise: Keep a loaded standby process that takes over if the worker dies.
        camera: Calibration file, or use --hfov-deg (default, with --frames: from EXIF).
        start: Where the flight begins (default: the last fix of an earlier bridge, or anywhere on the map).
        force: Replace an existing parameter file.
    """
    given = options.read_settings(settings)
    if out is None and connect is None:
        raise OptionError("connect: expected a link to the autopilot, got none")
    link: MavlinkSettings = table(given, "mavlink", connect=connect or "", firmware=firmware)
    if out is not None:
        _write_parameters(link, given, out, force)
    elif measure_delay:
        _measure_delay(link, pictures, given)
    else:
        from scenematch.runs.mavlink_bridge import run_mavlink_bridge

        files, how = pictures.files(site, given), _bridge_settings(matching, given)
        shown = options.live_view(rerun)
        status = run_mavlink_bridge(
            files, link, how, supervise=supervise, live_view=shown, progress=console.PROGRESS
        )
        console.facts(asdict(status), title=f"{link.kind} to {link.connect}")
        console.next_step("track --map MAP --frames VIDEO --telemetry LOG --out out")


def _measure_delay(link: MavlinkSettings, pictures: PictureOptions, settings: Settings) -> None:
    """Measure and print."""
    from scenematch.runs.camera_delay import measure_camera_delay

    source = pictures.camera_source
    if source is None:
        raise OptionError("camera_source: expected a camera to measure, got none")
    seconds, camera = table(settings, "bridge").seconds, pictures.camera_input(settings)
    found = measure_camera_delay(link, camera, source, seconds=seconds, progress=console.PROGRESS)
    delay_ms = round(1e3 * found.delay_s)
    values = {"exposure_to_grab_ms": delay_ms, "correlation": found.correlation}
    console.facts(values, title=f"camera {source}")
    measured = f"--settings input.exposure_to_grab_ms={delay_ms}"
    console.next_step(f"bridge mavlink --map MAP {measured}", hint="with the same options")


def _write_parameters(link: MavlinkSettings, settings: Settings, file: Path, force: bool) -> None:
    """Write the file and say so."""
    from scenematch.runs.mavlink_parameters import write_parameter_file

    wanted = table(settings, "parameters")
    write_parameter_file(file, link, wanted, force=force)
    if not console.answered_as_json({"parameters": str(file), "delay_ms": wanted.delay_ms}):
        console.say(f"written to {file}, for a delay of {wanted.delay_ms} ms")
    following = "bridge mavlink --connect LINK --map MAP --camera CAMERA --camera-source SOURCE"
    console.next_step(following, hint=f"load {file} into the autopilot")


@with_options
def ros(
    site: options.MapOptions,
    lens: options.CameraOptions,
    matching: options.MatchingOptions,
    ros_arguments: Annotated[list[str] | None, typer.Argument(metavar="NAME:=VALUE")] = None,
    version: Annotated[int, option("--ros", "1|2", INPUT)] = 2,
    image: Annotated[str | None, option("--image-topic", "NAME", INPUT)] = None,
    firmware: Annotated[str | None, option("--firmware", "none|ardupilot|px4", INPUT)] = None,
    settings: options.SettingsOption = None,
    rerun: options.RerunOption = None,
) -> None:
    """Run as a node of ROS 1 or ROS 2.

    Subscribes to images, attitude and height; publishes poses, fixes and diagnostics. Leave a
    topic out by giving it an empty name.

    Options:
        ros_arguments: ROS remaps; for ROS 2 after --ros-args, which also takes parameters.
        version: rospy or rclpy.
        image: Image topic, raw or compressed; set other topics by --settings ros.topics.imu=NAME.
        firmware: Autopilot behind MAVROS that receives the poses (default: none).
        camera: Calibration file (default: from the topic of the camera's calibration).
        start: Where the flight begins (default: anywhere on the map).
    """
    from dataclasses import replace

    from scenematch.runs.ros_bridge import run_ros_bridge

    given = options.read_settings(settings)
    node = table(
        given,
        "ros",
        map=site.map_input(given),
        camera=lens.camera_input(given),
        version=version,
        arguments=tuple(ros_arguments or ()),
        firmware=firmware,
    )
    if image is not None:
        node = replace(node, topics=replace(node.topics, image=image))
    how = _bridge_settings(matching, given)
    status = run_ros_bridge(node, how, live_view=options.live_view(rerun), progress=console.PROGRESS)
    console.facts(asdict(status), title=f"ROS {version} on {node.topics.image}")
    console.next_step("track --map MAP --frames BAG --out out")
