"""Whole runs as a library: track a flight, compare methods, campaigns, simulation, bridges.

::

    from engine.runs import FlightFiles, TrackSettings, track

    files = FlightFiles.in_folder("flight")
    summary = track(files, "out", TrackSettings(method="sift"))

Nothing here prints: a run reports to the :class:`Progress` that it is given. A message of an error names the
argument that it is about.
"""

from typing import TYPE_CHECKING

from engine.lazy_names import imported_on_use

if TYPE_CHECKING:
    from engine.formats.corrections import Corrections
    from engine.formats.datasets.sequence import ImportOptions
    from engine.runs.bag_conversion import convert_to_bag
    from engine.runs.bridge_files import BridgeFiles
    from engine.runs.campaign import run_campaign
    from engine.runs.checking import diagnose_flight
    from engine.runs.closed_loop import ClosedLoopSettings, fly_closed_loop
    from engine.runs.comparison import compare, parse_runs
    from engine.runs.dataset_import import PhotographOptions, check_flight, import_dataset, import_photographs
    from engine.runs.demo import run_demo
    from engine.runs.evaluation import evaluate
    from engine.runs.inputs import FlightFiles
    from engine.runs.live_viewing import LiveViewTarget
    from engine.runs.map_audit import AuditFiles, MapAudit, audit_map
    from engine.runs.map_fetch import FetchSettings, fetch_map
    from engine.runs.mavlink_bridge import (
        BridgeSettings,
        MavlinkSettings,
        run_mavlink_bridge,
    )
    from engine.runs.mavlink_parameters import write_parameter_file
    from engine.runs.progress import Progress
    from engine.runs.reporting import report
    from engine.runs.ros_bridge import RosSettings, run_ros_bridge
    from engine.runs.settings import TrackSettings, load_settings
    from engine.runs.simulation import WorldSettings, simulate
    from engine.runs.single_image import locate_image
    from engine.runs.track_export import export_track
    from engine.runs.tracking import track

__all__ = [
    "AuditFiles",
    "BridgeFiles",
    "BridgeSettings",
    "ClosedLoopSettings",
    "Corrections",
    "FetchSettings",
    "FlightFiles",
    "ImportOptions",
    "LiveViewTarget",
    "MapAudit",
    "MavlinkSettings",
    "PhotographOptions",
    "Progress",
    "RosSettings",
    "TrackSettings",
    "WorldSettings",
    "audit_map",
    "check_flight",
    "compare",
    "convert_to_bag",
    "diagnose_flight",
    "evaluate",
    "export_track",
    "fetch_map",
    "fly_closed_loop",
    "import_dataset",
    "import_photographs",
    "load_settings",
    "locate_image",
    "parse_runs",
    "report",
    "run_campaign",
    "run_demo",
    "run_mavlink_bridge",
    "run_ros_bridge",
    "simulate",
    "track",
    "write_parameter_file",
]

_NAMES = {
    "engine.formats.corrections": "Corrections",
    "engine.formats.datasets.sequence": "ImportOptions",
    "engine.runs.bag_conversion": "convert_to_bag",
    "engine.runs.campaign": "run_campaign",
    "engine.runs.checking": "diagnose_flight",
    "engine.runs.closed_loop": "ClosedLoopSettings fly_closed_loop",
    "engine.runs.comparison": "compare parse_runs",
    "engine.runs.dataset_import": "PhotographOptions check_flight import_dataset import_photographs",
    "engine.runs.demo": "run_demo",
    "engine.runs.evaluation": "evaluate",
    "engine.runs.inputs": "FlightFiles",
    "engine.runs.live_viewing": "LiveViewTarget",
    "engine.runs.map_audit": "AuditFiles MapAudit audit_map",
    "engine.runs.map_fetch": "FetchSettings fetch_map",
    "engine.runs.bridge_files": "BridgeFiles",
    "engine.runs.mavlink_bridge": "BridgeSettings MavlinkSettings run_mavlink_bridge",
    "engine.runs.mavlink_parameters": "write_parameter_file",
    "engine.runs.progress": "Progress",
    "engine.runs.reporting": "report",
    "engine.runs.ros_bridge": "RosSettings run_ros_bridge",
    "engine.runs.settings": "TrackSettings load_settings",
    "engine.runs.simulation": "WorldSettings simulate",
    "engine.runs.single_image": "locate_image",
    "engine.runs.track_export": "export_track",
    "engine.runs.tracking": "track",
}
"""The public names by module. A module is imported when one of its names is used: a run needs few of them."""

if not TYPE_CHECKING:  # checkers of types know the names above, and refuse others
    __getattr__ = imported_on_use(__name__, _NAMES)


def __dir__() -> list[str]:
    return __all__
