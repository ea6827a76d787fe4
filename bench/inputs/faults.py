"""Faults of the inputs: of telemetry, camera, clock, map and surface, each in two or three sizes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray

from engine import Camera, Frame, OrthoMap
from engine.values import Truth
from scenematch.files.flight import open_flight
from scenematch.files.truth import read_truth

Array = NDArray[Any]
Angles = Callable[[Array], Array]

FEET = 3.280839895


@dataclass(frozen=True, slots=True)
class FlightInputs:
    """A flight as the engine is given it.

    Attributes:
        frames: with their telemetry.
        camera: the calibration.
        gray: (H, W) the map.
        surface_m: (H, W) heights on the map's grid, or None.
        affine: (2, 3) from pixels to ``crs``.
        crs: of the map.
        truth: what is true, whatever the inputs say.
        georeference_sigma_m: accuracy that the map states.
    """

    frames: list[Frame]
    camera: Camera
    gray: Array
    surface_m: Array | None
    affine: Array
    crs: Any
    truth: list[Truth]
    georeference_sigma_m: float | None = 0.5

    def site(self) -> OrthoMap:
        """The map as it is given."""
        return OrthoMap.from_arrays(
            self.gray, self.affine, self.crs, surface_m=self.surface_m,
            georeference_sigma_m=self.georeference_sigma_m,
        )  # fmt: skip


def load(folder: Path, map_name: str = "map.tif", step: int = 1, count: int | None = None) -> FlightInputs:
    """A flight folder as it is; its map and surface are on one metric grid."""
    with rasterio.open(folder / map_name) as source:
        bands = source.read()
        corner, crs, shape = source.transform, source.crs, source.shape
    gray = bands[0] if len(bands) < 3 else cv2.cvtColor(np.moveaxis(bands[:3], 0, -1), cv2.COLOR_RGB2GRAY)
    affine = np.array([[corner.a, corner.b, corner.c], [corner.d, corner.e, corner.f]])
    affine[:, 2] += 0.5 * (affine[:, 0] + affine[:, 1])
    surface = None
    if (folder / "dsm.tif").is_file():
        from rasterio.warp import Resampling, reproject

        surface = np.full(shape, np.nan, np.float32)
        with rasterio.open(folder / "dsm.tif") as source:
            reproject(
                rasterio.band(source, 1), surface, dst_transform=corner, dst_crs=crs, dst_nodata=np.nan,
                resampling=Resampling.bilinear,
            )  # fmt: skip
    camera = Camera.load(folder / "camera.yaml")
    flown = open_flight(folder / "frames", folder / "telemetry.csv", camera)
    chosen = range(0, len(flown), step)[:count]
    frames = [flown.read(index).frame for index in chosen]
    return FlightInputs(
        frames, camera, np.ascontiguousarray(gray), surface, affine, crs, read_truth(folder / "truth.csv")
    )


Spoil = Callable[[FlightInputs], FlightInputs]
"""Puts a fault into the inputs of a flight."""

# ---------------------------------------------------------------------------------------------- telemetry


def _angles(change: Angles) -> Spoil:
    """All roll, pitch and heading (N, 3) by another rule."""

    def spoil(inputs: FlightInputs) -> FlightInputs:
        angles = np.array([(f.roll_deg or 0.0, f.pitch_deg or 0.0, f.heading_deg or 0.0) for f in inputs.frames])
        changed = change(angles)
        frames = [
            replace(f, roll_deg=float(r), pitch_deg=float(np.clip(p, -90, 90)), heading_deg=float(h % 360.0))
            for f, (r, p, h) in zip(inputs.frames, changed, strict=True)
        ]
        return replace(inputs, frames=frames)

    return spoil


def _each(change: Callable[[Frame, FlightInputs], Frame]) -> Spoil:
    """Every frame of a flight changed."""
    return lambda inputs: replace(inputs, frames=[change(frame, inputs) for frame in inputs.frames])


def raised(change: Callable[[float], float]) -> Spoil:
    def one(frame: Frame, _: FlightInputs) -> Frame:
        if frame.height_agl_m is None:
            return frame
        return replace(frame, height_agl_m=max(change(frame.height_agl_m), 1.0))

    return _each(one)


def late(seconds: float, *, attitude: bool = True, rest: bool = True) -> Spoil:
    """Telemetry of some time ago; of its parts, the attitude or the rest."""

    def spoil(inputs: FlightInputs) -> FlightInputs:
        time_s = np.array([(f.timestamp_ns or 0) * 1e-9 for f in inputs.frames])
        columns = {}
        for name in (("roll_deg", "pitch_deg", "heading_deg") if attitude else ()) + (
            ("height_agl_m", "east_velocity_mps", "north_velocity_mps") if rest else ()
        ):
            values = [getattr(f, name) for f in inputs.frames]
            if None in values:
                continue
            column = np.array(values, np.float64)
            if name == "heading_deg":
                column = np.degrees(np.unwrap(np.radians(column)))
            column = np.interp(time_s - seconds, time_s, column)
            columns[name] = column % 360.0 if name == "heading_deg" else column
        frames = [
            replace(f, **{name: float(column[k]) for name, column in columns.items()})
            for k, f in enumerate(inputs.frames)
        ]
        return replace(inputs, frames=frames)

    return spoil


def _velocity(change: Callable[[float, float], tuple[float, float]]) -> Spoil:
    def one(frame: Frame, _: FlightInputs) -> Frame:
        if frame.east_velocity_mps is None or frame.north_velocity_mps is None:
            return frame
        east, north = change(frame.east_velocity_mps, frame.north_velocity_mps)
        return replace(frame, east_velocity_mps=east, north_velocity_mps=north)

    return _each(one)


def _stamps(factor: float) -> Spoil:
    """Stamps in another unit, or of another frame rate; the truth keeps its own, by position in the list."""

    def one(frame: Frame, inputs: FlightInputs) -> Frame:
        first_ns = inputs.frames[0].timestamp_ns or 0
        since_ns = (frame.timestamp_ns or 0) - first_ns
        return replace(frame, timestamp_ns=round(first_ns * min(factor, 1.0) + since_ns * factor))

    return _each(one)


# ------------------------------------------------------------------------------------------------- camera


def lens(focal: float = 1.0, principal_px: float = 0.0) -> Spoil:
    def spoil(inputs: FlightInputs) -> FlightInputs:
        matrix = inputs.camera.matrix.copy()
        matrix[[0, 1], [0, 1]] *= focal
        matrix[:2, 2] += principal_px
        return replace(inputs, camera=replace(inputs.camera, matrix=matrix))

    return spoil


def mounted(turn_deg: float = 0.0, tilt_deg: float = 0.0) -> Spoil:
    """The calibration's mount turned about the optical axis, and tilted about the body's right axis."""

    def spoil(inputs: FlightInputs) -> FlightInputs:
        about_axis = cv2.Rodrigues(np.array([0.0, 0.0, np.radians(turn_deg)]))[0]
        about_right = cv2.Rodrigues(np.array([0.0, np.radians(tilt_deg), 0.0]))[0]
        return replace(inputs, camera=replace(inputs.camera, mount=about_right @ inputs.camera.mount @ about_axis))

    return spoil


def _pictures(change: Callable[[Array], Array]) -> Spoil:
    return _each(lambda f, _: replace(f, image=np.ascontiguousarray(change(np.asarray(f.image)))))


def _distorted(k1: float) -> Spoil:
    """Pictures of a lens with distortion, whose calibration says that it has none."""

    def spoil(inputs: FlightInputs) -> FlightInputs:
        camera = inputs.camera
        grid = np.stack(np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px)), -1).reshape(-1, 1, 2)
        flat = cv2.undistortPoints(grid.astype(np.float64), camera.matrix, np.array([k1, 0, 0, 0, 0]))
        there = flat.reshape(-1, 2) * camera.matrix[[0, 1], [0, 1]] + camera.matrix[:2, 2]
        lattice = there.reshape(camera.height_px, camera.width_px, 2).astype(np.float32)
        return _pictures(
            lambda image: cv2.remap(image, lattice, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        )(inputs)

    return spoil


def _rolling(readout_ms: float) -> Spoil:
    """Rows read one after the other: the picture shears by the vehicle's own motion."""

    def one(f: Frame, inputs: FlightInputs) -> Frame:
        width, height = inputs.camera.width_px, inputs.camera.height_px
        speed = np.array([f.east_velocity_mps or 0.0, f.north_velocity_mps or 0.0])
        heading = np.radians(f.heading_deg or 0.0)
        along = speed @ [np.sin(heading), np.cos(heading)], speed @ [np.cos(heading), -np.sin(heading)]
        px_per_s = inputs.camera.focal_px / (f.height_agl_m or 100.0)
        dy, dx = along[0] * px_per_s * readout_ms * 1e-3, -along[1] * px_per_s * readout_ms * 1e-3
        shear = np.array([[1.0, dx / height, -dx / 2], [0.0, 1.0 + dy / height, -dy / 2]])
        image = cv2.warpAffine(np.asarray(f.image), shear, (width, height), borderMode=cv2.BORDER_REFLECT)
        return replace(f, image=np.ascontiguousarray(image))

    return _each(one)


def _frozen(every_s: float, for_s: float) -> Spoil:
    def spoil(inputs: FlightInputs) -> FlightInputs:
        frames, held, first = [], None, inputs.frames[0].timestamp_ns or 0
        for f in inputs.frames:
            is_frozen = ((f.timestamp_ns or 0) - first) * 1e-9 % every_s >= every_s - for_s
            held = held if is_frozen and held is not None else f.image
            frames.append(replace(f, image=held))
        return replace(inputs, frames=frames)

    return spoil


def _kept(every: int) -> Spoil:
    return lambda inputs: replace(inputs, frames=inputs.frames[::every])


# -------------------------------------------------------------------------------------------- map, surface


def _ground(
    shift_m: tuple[float, float] = (0.0, 0.0), scale: float = 1.0, turn_deg: float = 0.0, *, surface: str = "both"
) -> Spoil:
    """What the map shows, moved on its own grid; with its surface model, without it, or that alone."""

    def spoil(inputs: FlightInputs) -> FlightInputs:
        height, width = inputs.gray.shape
        gsd = float(abs(inputs.affine[0, 0]))
        matrix = cv2.getRotationMatrix2D((width / 2.0, height / 2.0), -turn_deg, scale)
        matrix[:, 2] += np.array([shift_m[0], -shift_m[1]]) / gsd
        gray, heights = inputs.gray, inputs.surface_m
        if surface != "only":
            gray = cv2.warpAffine(gray, matrix, (width, height), borderMode=cv2.BORDER_REFLECT)
        if heights is not None and surface != "none":
            heights = cv2.warpAffine(heights, matrix, (width, height), borderMode=cv2.BORDER_REPLICATE)
        return replace(inputs, gray=np.ascontiguousarray(gray), surface_m=heights)

    return spoil


def _heights(change: Callable[[Array], Array]) -> Spoil:
    return lambda inputs: (
        inputs if inputs.surface_m is None else replace(inputs, surface_m=change(inputs.surface_m))
    )


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of some size.

    Attributes:
        name: of the row.
        causes: what a diagnosis may rightly call it; empty where it need not say anything.
        spoil: makes it.
    """

    name: str
    causes: tuple[str, ...]
    spoil: Spoil


def turned(*offsets_deg: float) -> Spoil:
    return _angles(lambda angles: angles + np.array(offsets_deg))


def _times(*factors: float) -> Spoil:
    return _angles(lambda angles: angles * np.array(factors))


def _quarter_turned(image: Array) -> Array:
    """A picture that is not square cannot be turned by 90 degrees within its calibration."""
    return np.rot90(image) if image.shape[0] == image.shape[1] else image[::-1, ::-1]


_RADIANS = float(np.pi / 180.0)
_TELEMETRY: dict[str, tuple[str, dict[str, Spoil]]] = {
    "angles in radians:": ("radians", {
        "all": _angles(np.radians), "heading": _times(1, 1, _RADIANS), "tilt": _times(_RADIANS, _RADIANS, 1)}),
    "angles converted twice": ("degrees", {"": _angles(np.degrees)}),
    "roll and pitch swapped": ("swapped", {"": _angles(lambda a: a[:, [1, 0, 2]])}),
    "sign turned:": ("sign", {"both": _times(-1, -1, 1), "roll": _times(-1, 1, 1), "pitch": _times(1, -1, 1)}),
    "heading off by": ("heading", {"3": turned(0, 0, 3), "8": turned(0, 0, 8), "20": turned(0, 0, 20)}),
    "heading counted": ("heading_convention", {
        "counter-clockwise": _times(1, 1, -1), "from east": _angles(lambda a: a * [1, 1, -1] + [0, 0, 90])}),
    "roll and pitch off by": ("mount", {"2": turned(2, 2, 0), "5": turned(5, -5, 0)}),
    "height off by": ("height", {
        "10 m": raised(lambda h: h + 10), "20 m": raised(lambda h: h + 20), "-20 m": raised(lambda h: h - 20)}),
    "height above sea level, ground at": ("height", {
        "50 m": raised(lambda h: h + 50), "200 m": raised(lambda h: h + 200)}),
    "height in feet": ("height height_feet", {"": raised(lambda h: h * FEET)}),
    "telemetry late by": ("clock", {"0.1 s": late(0.1), "0.5 s": late(0.5), "2 s": late(2.0)}),
    "attitude alone late by": ("clock", {"0.1 s": late(0.1, rest=False), "0.3 s": late(0.3, rest=False)}),
    "velocity": ("velocity", {
        "swapped": _velocity(lambda e, n: (n, e)), "in km/h": _velocity(lambda e, n: (3.6 * e, 3.6 * n)),
        "reversed": _velocity(lambda e, n: (-e, -n))}),
    "stamps in": ("velocity", {"milliseconds": _stamps(1e-6), "microseconds": _stamps(1e-3)}),
    "frame rate times": ("velocity", {"1.5": _stamps(1 / 1.5), "0.5": _stamps(2.0)}),
}  # fmt: skip
_CAMERA: dict[str, tuple[str, dict[str, Spoil]]] = {
    "focal length off by": ("focal height", {
        "-20 %": lens(0.8), "-5 %": lens(0.95), "5 %": lens(1.05), "20 %": lens(1.2)}),
    "principal point off by": ("mount", {"10 px": lens(principal_px=10), "30 px": lens(principal_px=30)}),
    "distortion missing, k1": ("focal height", {"-0.05": _distorted(-0.05), "-0.2": _distorted(-0.2)}),
    "mount turned by": ("mount heading", {"90": mounted(90), "180": mounted(180), "3": mounted(3)}),
    "mount tilted by": ("mount", {"3": mounted(tilt_deg=3), "10": mounted(tilt_deg=10)}),
    "pictures mirrored": ("mirrored", {
        "left to right": _pictures(lambda i: i[:, ::-1]), "top to bottom": _pictures(lambda i: i[::-1])}),
    "pictures turned by EXIF": ("mount", {
        "90": _pictures(_quarter_turned), "180": _pictures(lambda i: i[::-1, ::-1])}),
    "rolling shutter": ("", {"20 ms": _rolling(20), "60 ms": _rolling(60)}),
    "pictures frozen": ("frozen", {"5 of 15 s": _frozen(15, 5), "2 of 6 s": _frozen(6, 2)}),
    "one picture of": ("", {"3": _kept(3), "10": _kept(10)}),
}  # fmt: skip
_MAP: dict[str, tuple[str, dict[str, Spoil]]] = {
    "map shifted by": ("map", {"5 m": _ground((3, 4)), "8 m": _ground((8, 0)), "40 m": _ground((-32, 24))}),
    "map scaled by": ("height focal", {"2 %": _ground(scale=1.02), "10 %": _ground(scale=1.1)}),
    "map turned by": ("heading", {"2": _ground(turn_deg=2), "5": _ground(turn_deg=5)}),
    "surface shifted by": ("surface", {
        "10 m": _ground((6, 8), surface="only"), "30 m": _ground((-18, 24), surface="only")}),
    "surface": ("surface height", {
        "inverted": _heights(lambda z: 2 * np.float32(np.nanpercentile(z, 20)) - z),
        "in feet": _heights(lambda z: z * np.float32(FEET))}),
}  # fmt: skip


def faults() -> list[Fault]:
    """All of them, by what they are of; a map that is wrong does not say how good it is."""
    rows = [Fault("none", (), lambda inputs: inputs)]
    for table, stated in ((_TELEMETRY, True), (_CAMERA, True), (_MAP, False)):
        for name, (causes, sizes) in table.items():
            for size, spoil in sizes.items():
                told = spoil if stated else _without_accuracy(spoil)
                rows.append(Fault(f"{name} {size}".strip(), tuple(causes.split()), told))
    return rows


def _without_accuracy(spoil: Spoil) -> Spoil:
    return lambda inputs: replace(spoil(inputs), georeference_sigma_m=None)
