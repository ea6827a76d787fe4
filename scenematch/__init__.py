"""The product around the engine, as a library: track flights, compare methods, simulate, bridge to autopilots.

::

    from scenematch import FlightFiles, TrackSettings, track

    files = FlightFiles.in_folder("flight")
    summary = track(files, "out", TrackSettings(method="sift"))

Nothing here prints: a run reports to its :class:`Progress`. Error messages name the argument at fault.
"""

from typing import TYPE_CHECKING

from engine.runtime.lazy_names import imported_on_use

_NAMES = {
    "scenematch.bridges.vehicle": "RecentValues",
    "scenematch.files.corrections": "Corrections",
    "scenematch.runs.bridge_files": "BridgeFiles",
    "scenematch.runs.cameras": "CameraInput",
    "scenematch.runs.checking": "diagnose_flight",
    "scenematch.runs.closed_loop": "ClosedLoopSettings fly_closed_loop",
    "scenematch.runs.comparison": "compare parse_runs",
    "scenematch.runs.demo": "run_demo",
    "scenematch.runs.evaluation": "evaluate report",
    "scenematch.runs.inputs": "FlightFiles",
    "scenematch.runs.live_viewing": "LiveViewTarget",
    "scenematch.runs.map_audit": "AuditFiles MapAudit audit_map",
    "scenematch.fetch.grid": "FetchSettings",
    "scenematch.runs.map_fetch": "fetch_map",
    "scenematch.runs.map_input": "MapInput",
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

__all__ = sorted(" ".join(_NAMES.values()).split())

if TYPE_CHECKING:  # the same names for type checkers, which reject others; `as` makes them public
    from scenematch.bridges.vehicle import RecentValues as RecentValues
    from scenematch.fetch.grid import FetchSettings as FetchSettings
    from scenematch.files.corrections import Corrections as Corrections
    from scenematch.runs.bridge_files import BridgeFiles as BridgeFiles
    from scenematch.runs.cameras import CameraInput as CameraInput
    from scenematch.runs.checking import diagnose_flight as diagnose_flight
    from scenematch.runs.closed_loop import ClosedLoopSettings as ClosedLoopSettings
    from scenematch.runs.closed_loop import fly_closed_loop as fly_closed_loop
    from scenematch.runs.comparison import compare as compare
    from scenematch.runs.comparison import parse_runs as parse_runs
    from scenematch.runs.demo import run_demo as run_demo
    from scenematch.runs.evaluation import evaluate as evaluate
    from scenematch.runs.evaluation import report as report
    from scenematch.runs.inputs import FlightFiles as FlightFiles
    from scenematch.runs.live_viewing import LiveViewTarget as LiveViewTarget
    from scenematch.runs.map_audit import AuditFiles as AuditFiles
    from scenematch.runs.map_audit import MapAudit as MapAudit
    from scenematch.runs.map_audit import audit_map as audit_map
    from scenematch.runs.map_fetch import fetch_map as fetch_map
    from scenematch.runs.map_input import MapInput as MapInput
    from scenematch.runs.mavlink_bridge import BridgeSettings as BridgeSettings
    from scenematch.runs.mavlink_bridge import MavlinkSettings as MavlinkSettings
    from scenematch.runs.mavlink_bridge import run_mavlink_bridge as run_mavlink_bridge
    from scenematch.runs.mavlink_parameters import write_parameter_file as write_parameter_file
    from scenematch.runs.output import Progress as Progress
    from scenematch.runs.ros_bridge import RosSettings as RosSettings
    from scenematch.runs.ros_bridge import run_ros_bridge as run_ros_bridge
    from scenematch.runs.settings import TrackSettings as TrackSettings
    from scenematch.runs.settings import load_settings as load_settings
    from scenematch.runs.simulation import WorldSettings as WorldSettings
    from scenematch.runs.simulation import simulate as simulate
    from scenematch.runs.single_image import locate_image as locate_image
    from scenematch.runs.track_export import export_track as export_track
    from scenematch.runs.tracking import track as track
else:
    __getattr__ = imported_on_use(__name__, _NAMES)


def __dir__() -> list[str]:
    return __all__
