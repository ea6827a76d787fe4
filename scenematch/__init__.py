"""The product around the engine, as a library: track flights, compare methods, simulate, bridge to autopilots.

::

    from scenematch import FlightFiles, TrackSettings, track

    files = FlightFiles.in_folder("flight")
    summary = track(files, "out", TrackSettings(method="sift"))

Nothing here prints: a run reports to its :class:`Progress`. Error messages name the argument at fault.
"""

from typing import TYPE_CHECKING

from engine.runtime.lazy_names import imported_on_use

if TYPE_CHECKING:
    from scenematch.bridges.vehicle import RecentValues
    from scenematch.files.corrections import Corrections
    from scenematch.runs.bridge_files import BridgeFiles
    from scenematch.runs.cameras import CameraInput
    from scenematch.runs.checking import diagnose_flight
    from scenematch.runs.closed_loop import ClosedLoopSettings, fly_closed_loop
    from scenematch.runs.comparison import compare, parse_runs
    from scenematch.runs.demo import run_demo
    from scenematch.runs.evaluation import evaluate, report
    from scenematch.runs.inputs import FlightFiles
    from scenematch.runs.live_viewing import LiveViewTarget
    from scenematch.runs.map_audit import AuditFiles, MapAudit, audit_map
    from scenematch.runs.map_fetch import FetchSettings, fetch_map
    from scenematch.runs.map_input import MapInput
    from scenematch.runs.mavlink_bridge import (
        BridgeSettings,
        MavlinkSettings,
        run_mavlink_bridge,
    )
    from scenematch.runs.mavlink_parameters import write_parameter_file
    from scenematch.runs.output import Progress
    from scenematch.runs.ros_bridge import RosSettings, run_ros_bridge
    from scenematch.runs.settings import TrackSettings, load_settings
    from scenematch.runs.simulation import WorldSettings, simulate
    from scenematch.runs.single_image import locate_image
    from scenematch.runs.track_export import export_track
    from scenematch.runs.tracking import track

__all__ = [
    "AuditFiles",
    "BridgeFiles",
    "BridgeSettings",
    "CameraInput",
    "ClosedLoopSettings",
    "Corrections",
    "FetchSettings",
    "FlightFiles",
    "LiveViewTarget",
    "MapAudit",
    "MapInput",
    "MavlinkSettings",
    "Progress",
    "RecentValues",
    "RosSettings",
    "TrackSettings",
    "WorldSettings",
    "audit_map",
    "compare",
    "diagnose_flight",
    "evaluate",
    "export_track",
    "fetch_map",
    "fly_closed_loop",
    "load_settings",
    "locate_image",
    "parse_runs",
    "report",
    "run_demo",
    "run_mavlink_bridge",
    "run_ros_bridge",
    "simulate",
    "track",
    "write_parameter_file",
]

_NAMES = {
    "scenematch.bridges.vehicle": "RecentValues",
    "scenematch.files.corrections": "Corrections",
    "scenematch.runs.cameras": "CameraInput",
    "scenematch.runs.checking": "diagnose_flight",
    "scenematch.runs.closed_loop": "ClosedLoopSettings fly_closed_loop",
    "scenematch.runs.comparison": "compare parse_runs",
    "scenematch.runs.demo": "run_demo",
    "scenematch.runs.evaluation": "evaluate report",
    "scenematch.runs.inputs": "FlightFiles",
    "scenematch.runs.live_viewing": "LiveViewTarget",
    "scenematch.runs.map_audit": "AuditFiles MapAudit audit_map",
    "scenematch.runs.map_fetch": "FetchSettings fetch_map",
    "scenematch.runs.map_input": "MapInput",
    "scenematch.runs.bridge_files": "BridgeFiles",
    "scenematch.runs.mavlink_bridge": "BridgeSettings MavlinkSettings run_mavlink_bridge",
    "scenematch.runs.mavlink_parameters": "write_parameter_file",
    "scenematch.runs.output": "Progress",
    "scenematch.runs.ros_bridge": "RosSettings run_ros_bridge",
    "scenematch.runs.settings": "TrackSettings load_settings",
    "scenematch.runs.simulation": "WorldSettings simulate",
    "scenematch.runs.single_image": "locate_image",
    "scenematch.runs.track_export": "export_track",
    "scenematch.runs.tracking": "track",
}
"""The public names by module. A module is imported only when one of its names is used."""

if not TYPE_CHECKING:  # type checkers know the names above and reject others
    __getattr__ = imported_on_use(__name__, _NAMES)


def __dir__() -> list[str]:
    return __all__
