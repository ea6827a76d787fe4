"""The commands of `bridge`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from scenematch.cli import console
from scenematch.cli.options import (
    BridgeDeadlineOption,
    CameraPitchOption,
    CoresOption,
    DeadlineOption,
    DeviceOption,
    EveryOption,
    FirmwareOption,
    HfovOption,
    JsonOption,
    KeyOption,
    ListenAnywhereOption,
    MapBoundsOption,
    MapCrsOption,
    MapOption,
    MapSigmaOption,
    MaxSigmaOption,
    MessageOption,
    MethodOption,
    MountOption,
    NiceOption,
    OdometryOption,
    OptionalCameraOption,
    RealtimeOption,
    RerunConnectOption,
    RerunOption,
    SecondsOption,
    StartOption,
    SurfaceOption,
    SystemIdOption,
    ThreadsOption,
    WeightsOption,
    use_threads,
)


def mavlink(
    connect: Annotated[
        str,
        typer.Option(
            "--connect",
            metavar="LINK",
            help="udpin:HOST:PORT, udp:PORT, udpout:HOST:PORT, tcp:HOST:PORT, serial:DEVICE:BAUD.",
        ),
    ],
    map_path: MapOption,
    camera: OptionalCameraOption = None,
    hfov_deg: HfovOption = None,
    mount: MountOption = None,
    camera_pitch_deg: CameraPitchOption = None,
    surface: SurfaceOption = None,
    map_sigma_m: MapSigmaOption = None,
    map_bounds: MapBoundsOption = None,
    map_crs: MapCrsOption = None,
    frames: Annotated[
        Path | None,
        typer.Option("--frames", metavar="DIR|VIDEO", help="Pictures to play at their own pace."),
    ] = None,
    telemetry: Annotated[
        Path | None,
        typer.Option(
            "--telemetry", metavar="FILE", help="telemetry.csv, whose stamps set that pace; else a video's own."
        ),
    ] = None,
    rate_hz: Annotated[
        float | None,
        typer.Option("--rate-hz", metavar="HZ", help="The pace of pictures without stamps; 10 unless given."),
    ] = None,
    every: EveryOption = 1,
    camera_source: Annotated[
        str | None,
        typer.Option("--camera-source", metavar="N|URL|exec:CMD", help="A camera, or a command for JPEGs."),
    ] = None,
    exposure_to_grab_ms: Annotated[
        float | None,
        typer.Option("--exposure-to-grab-ms", metavar="MS", help="How long its pictures take to get here."),
    ] = None,
    gimbal: Annotated[
        bool, typer.Option("--gimbal", help="The camera hangs on a gimbal that the autopilot reports.")
    ] = False,
    firmware: FirmwareOption = "ardupilot",
    message: MessageOption = "",
    max_sigma_m: MaxSigmaOption = 10.0,
    gps_id: Annotated[
        int, typer.Option("--gps-id", metavar="N", help="Receiver that gps_input poses as; 0 is the first.")
    ] = 0,
    system_id: SystemIdOption = 1,
    component_id: Annotated[
        int,
        typer.Option("--component-id", metavar="N", help="Of the vehicle, that the bridge is: not another VIO's."),
    ] = 197,
    key: KeyOption = None,
    listen_anywhere: ListenAnywhereOption = False,
    set_origin: Annotated[
        bool, typer.Option("--set-origin/--no-set-origin", help="Give an autopilot without an origin the map's.")
    ] = True,
    origin_alt_m: Annotated[
        float | None,
        typer.Option("--origin-alt-m", metavar="M", help="Its height above sea level; else the map's ground."),
    ] = None,
    use_velocity: Annotated[
        bool, typer.Option("--velocity/--no-velocity", help="Whether the autopilot's velocity is used.")
    ] = True,
    check_gnss: Annotated[
        bool,
        typer.Option("--check-gnss/--no-check-gnss", help="Hold the first fixes against its GNSS receiver."),
    ] = True,
    method: MethodOption = "auto",
    weights: WeightsOption = None,
    start: StartOption = None,
    odometry: OdometryOption = False,
    device: DeviceOption = "auto",
    deadline_ms: BridgeDeadlineOption = None,
    seconds: SecondsOption = None,
    supervise: Annotated[
        bool, typer.Option("--supervise", help="Replace a worker that is killed, with all that is loaded.")
    ] = False,
    recording: RerunOption = None,
    viewer: RerunConnectOption = None,
    realtime: RealtimeOption = False,
    nice: NiceOption = None,
    cores: CoresOption = None,
    threads: ThreadsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """Fixes to an autopilot by MAVLink.

    Reads attitude, height and velocity from the autopilot and sends it the fixes of a camera or of pictures
    played at their own pace, until they end.
    """
    from scenematch.runs.arguments import parse_realtime
    from scenematch.runs.bridge_files import BridgeFiles
    from scenematch.runs.cameras import CameraInput
    from scenematch.runs.live_viewing import LiveViewTarget
    from scenematch.runs.map_input import MapInput
    from scenematch.runs.mavlink_bridge import BridgeSettings, MavlinkSettings, run_mavlink_bridge

    use_threads(threads)
    files = BridgeFiles(
        map=MapInput(
            map_path, surface=surface, map_sigma_m=map_sigma_m, map_bounds=map_bounds, map_crs=map_crs
        ),
        camera=CameraInput(camera, hfov_deg=hfov_deg, mount=mount, camera_pitch_deg=camera_pitch_deg),
        frames=frames, telemetry=telemetry, camera_source=camera_source, rate_hz=rate_hz, every=every, exposure_to_grab_ms=exposure_to_grab_ms,
        gimbal=gimbal,
    )  # fmt: skip
    link = MavlinkSettings(
        connect=connect, listen_anywhere=listen_anywhere, system_id=system_id, component_id=component_id,
        key=key, firmware=firmware, message=message, max_sigma_m=max_sigma_m, set_origin=set_origin,
        origin_alt_m=origin_alt_m, use_velocity=use_velocity, check_gnss=check_gnss, gps_id=gps_id,
    )  # fmt: skip
    settings = BridgeSettings(
        method=method, weights=tuple(weights or ()), device=device, start=start, deadline_ms=deadline_ms,
        seconds=seconds, odometry=odometry, realtime=parse_realtime(realtime, nice, cores),
    )  # fmt: skip
    live_view = LiveViewTarget(recording, viewer)
    status = run_mavlink_bridge(
        files, link, settings, supervise=supervise, live_view=live_view, progress=console.PROGRESS
    )
    console.facts(asdict(status), as_json, title=f"{link.outgoing().kind} to {connect}")
    flown = console.options(
        map=map_path, surface=surface, camera=camera, hfov_deg=hfov_deg, frames=frames, telemetry=telemetry
    )
    recorded = "" if frames else " --frames VIDEO --telemetry LOG"
    console.next_step(f"track {flown}{recorded} --out out", as_json=as_json)


def camera_delay(
    connect: Annotated[
        str,
        typer.Option("--connect", metavar="LINK", help="The autopilot, as of bridge mavlink."),
    ],
    camera_source: Annotated[
        str,
        typer.Option("--camera-source", metavar="N|URL|exec:CMD", help="A camera, or a command for JPEGs."),
    ],
    camera: OptionalCameraOption = None,
    hfov_deg: HfovOption = None,
    seconds: Annotated[
        float, typer.Option("--seconds", min=5.0, metavar="S", help="How long pictures are taken.")
    ] = 20.0,
    mount: MountOption = None,
    firmware: FirmwareOption = "ardupilot",
    system_id: SystemIdOption = 1,
    key: KeyOption = None,
    listen_anywhere: ListenAnywhereOption = False,
    as_json: JsonOption = False,
) -> None:
    """How late a camera's pictures arrive.

    Compares the turns that the pictures show with those of the autopilot's attitude, while the vehicle is tilted
    to and fro by hand. The result is for --exposure-to-grab-ms.
    """
    from scenematch.runs.camera_delay import measure_camera_delay
    from scenematch.runs.cameras import CameraInput

    found = measure_camera_delay(
        connect, CameraInput(camera, hfov_deg=hfov_deg, mount=mount), camera_source, seconds=seconds,
        firmware=firmware, system_id=system_id, key=key, listen_anywhere=listen_anywhere,
        progress=console.PROGRESS,
    )  # fmt: skip
    values = {"exposure_to_grab_ms": round(1e3 * found.delay_s), "correlation": found.correlation}
    console.facts(values, as_json, title=f"camera {camera_source}")
    late = console.options(
        connect=connect, camera=camera, hfov_deg=hfov_deg, camera_source=camera_source,
        exposure_to_grab_ms=values["exposure_to_grab_ms"],
    )  # fmt: skip
    console.next_step(f"bridge mavlink --map MAP {late}", as_json=as_json)


def mavlink_params(
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="Parameter file, created by this run.")],
    firmware: FirmwareOption = "ardupilot",
    message: MessageOption = "",
    takeoff: Annotated[
        str, typer.Option("--takeoff", metavar="none|gnss", help="What ArduPilot takes off with.")
    ] = "none",
    gps_id: Annotated[
        int, typer.Option("--gps-id", metavar="N", help="Receiver that gps_input poses as; 0 is the first.")
    ] = 0,
    delay_ms: Annotated[
        int | None,
        typer.Option(
            "--delay-ms", metavar="MS", help="From capture to arrival; else as the last bridge measured."
        ),
    ] = None,
    max_sigma_m: MaxSigmaOption = 10.0,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that exists.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Parameters for an autopilot.

    Writes the file that tells ArduPilot or PX4 to fly by the bridge's fixes.
    """
    from scenematch.runs.mavlink_parameters import write_parameter_file

    written = write_parameter_file(
        firmware,
        message,
        out,
        takeoff=takeoff,
        gps_id=gps_id,
        delay_ms=delay_ms,
        max_sigma_m=max_sigma_m,
        force=force,
    )
    if as_json:
        console.print_json({"parameters": str(out)} | asdict(written))
    else:
        console.say(f"written to {out}, for a delay of {written.delay_ms} ms ({written.delay_source})")
    console.next_step(
        "bridge mavlink --connect LINK --map MAP --camera CAMERA --camera-source SOURCE",
        as_json=as_json,
        hint=f"load {out} into the autopilot",
    )


def ros(
    map_path: MapOption,
    ros_arguments: Annotated[
        list[str] | None,
        typer.Argument(metavar="NAME:=VALUE", help="Of ROS: remaps; of ROS 2 after --ros-args, and parameters."),
    ] = None,
    version: Annotated[int, typer.Option("--ros", metavar="1|2", help="rospy or rclpy.")] = 1,
    surface: SurfaceOption = None,
    map_sigma_m: MapSigmaOption = None,
    map_bounds: MapBoundsOption = None,
    map_crs: MapCrsOption = None,
    camera: Annotated[
        Path | None,
        typer.Option("--camera", metavar="FILE", help="Calibration; without it the topic's, of a nadir camera."),
    ] = None,
    hfov_deg: HfovOption = None,
    mount: MountOption = None,
    camera_pitch_deg: CameraPitchOption = None,
    image: Annotated[
        str, typer.Option("--image-topic", metavar="NAME", help="sensor_msgs/Image; CompressedImage by its name.")
    ] = "/camera/image_raw",
    camera_info: Annotated[
        str, typer.Option("--camera-info-topic", metavar="NAME", help="sensor_msgs/CameraInfo.")
    ] = "/camera/camera_info",
    imu: Annotated[
        str, typer.Option("--imu-topic", metavar="NAME", help="sensor_msgs/Imu with an orientation.")
    ] = "/mavros/imu/data",
    compass: Annotated[
        str, typer.Option("--compass-topic", metavar="NAME", help="std_msgs/Float64, degrees; outranks the Imu.")
    ] = "",
    height: Annotated[
        str, typer.Option("--height-topic", metavar="NAME", help="std_msgs/Float64, metres above take-off.")
    ] = "/mavros/global_position/rel_alt",
    ranging: Annotated[
        str, typer.Option("--range-topic", metavar="NAME", help="sensor_msgs/Range; outranks the height.")
    ] = "/mavros/rangefinder/rangefinder",
    velocity: Annotated[
        str, typer.Option("--velocity-topic", metavar="NAME", help="geometry_msgs/TwistStamped, east and north.")
    ] = "/mavros/local_position/velocity_local",
    odometry_topic: Annotated[
        str,
        typer.Option(
            "--odometry-topic", metavar="NAME", help="Another odometry's velocity; outranks the velocity."
        ),
    ] = "",
    odometry_type: Annotated[
        str,
        typer.Option(
            "--odometry-type",
            metavar="NAME",
            help="Its message: Odometry, TwistWithCovarianceStamped or TwistStamped.",
        ),
    ] = "Odometry",
    firmware: Annotated[
        str,
        typer.Option("--firmware", metavar="none|ardupilot|px4", help="For whom the poses are, behind MAVROS."),
    ] = "none",
    origin: Annotated[
        str | None, typer.Option("--origin", metavar="LAT,LON", help="Of the poses; without it the map's.")
    ] = None,
    method: MethodOption = "auto",
    weights: WeightsOption = None,
    start: StartOption = None,
    odometry: OdometryOption = False,
    device: DeviceOption = "auto",
    deadline_ms: DeadlineOption = 121.0,
    seconds: SecondsOption = None,
    recording: RerunOption = None,
    viewer: RerunConnectOption = None,
    realtime: RealtimeOption = False,
    nice: NiceOption = None,
    cores: CoresOption = None,
    threads: ThreadsOption = 1,
    as_json: JsonOption = False,
) -> None:
    """A node of ROS 1 or ROS 2.

    Hears pictures, attitude and height, and publishes poses, fixes, diagnostics and the window that was searched.
    An empty name of a topic leaves it out.
    """
    from scenematch.bridges.ros import RosTopics
    from scenematch.runs.arguments import parse_realtime
    from scenematch.runs.cameras import CameraInput
    from scenematch.runs.live_viewing import LiveViewTarget
    from scenematch.runs.map_input import MapInput
    from scenematch.runs.mavlink_bridge import BridgeSettings
    from scenematch.runs.ros_bridge import RosSettings, run_ros_bridge

    use_threads(threads)
    topics = RosTopics(
        image=image, camera_info=camera_info, imu=imu, compass=compass, height=height, range=ranging,
        velocity=velocity, odometry=odometry_topic, odometry_type=odometry_type,
    )  # fmt: skip
    settings = BridgeSettings(
        method=method, weights=tuple(weights or ()), device=device, start=start, deadline_ms=deadline_ms,
        seconds=seconds, odometry=odometry, realtime=parse_realtime(realtime, nice, cores),
    )  # fmt: skip
    ros_settings = RosSettings(
        map=MapInput(
            map_path, surface=surface, map_sigma_m=map_sigma_m, map_bounds=map_bounds, map_crs=map_crs
        ),
        camera=CameraInput(camera, hfov_deg=hfov_deg, mount=mount, camera_pitch_deg=camera_pitch_deg),
        topics=topics, version=version, firmware=firmware, origin=origin, arguments=tuple(ros_arguments or ()),
    )  # fmt: skip
    live_view = LiveViewTarget(recording, viewer)
    status = run_ros_bridge(ros_settings, settings, live_view=live_view, progress=console.PROGRESS)
    console.facts(asdict(status), as_json, title=f"ROS {version} on {image}")
    console.next_step(
        f"track {console.options(map=map_path, surface=surface)} --frames BAG --out out", as_json=as_json
    )
