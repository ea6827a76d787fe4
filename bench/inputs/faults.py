"""Faults of what the engine is told: of telemetry, camera, clock, map and surface, each in two or three sizes."""

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
from engine.formats.flight import open_flight
from engine.formats.truth import read_truth
from engine.values import Truth

Array = NDArray[Any]
Angles = Callable[[Array], Array]

FEET = 3.280839895


@dataclass(frozen=True, slots=True)
class Told:
    """A flight as the engine is told of it.

    Attributes:
        frames: with their telemetry.
        camera: the calibration.
        gray: (H, W) the map.
        surface_m: (H, W) heights on the map's grid, or None.
        affine: (2, 3) from pixels to ``crs``.
        crs: of the map.
        truth: what is true, whatever is told.
    """

    frames: list[Frame]
    camera: Camera
    gray: Array
    surface_m: Array | None
    affine: Array
    crs: Any
    truth: list[Truth]

    def site(self) -> OrthoMap:
        """The map as it is told, good to 0.5 m as far as it says."""
        return OrthoMap.from_arrays(
            self.gray, self.affine, self.crs, surface_m=self.surface_m, georeference_sigma_m=0.5
        )


def load(folder: Path, map_name: str = "map.tif", step: int = 1, count: int | None = None) -> Told:
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
    return Told(frames, camera, np.ascontiguousarray(gray), surface, affine, crs, read_truth(folder / "truth.csv"))


# ---------------------------------------------------------------------------------------------- telemetry


def _angles(change: Angles) -> Callable[[Told], Told]:
    """All roll, pitch and heading (N, 3) by another rule."""

    def spoil(told: Told) -> Told:
        angles = np.array([(f.roll_deg or 0.0, f.pitch_deg or 0.0, f.heading_deg or 0.0) for f in told.frames])
        changed = change(angles)
        frames = [
            replace(f, roll_deg=float(r), pitch_deg=float(np.clip(p, -90, 90)), heading_deg=float(h % 360.0))
            for f, (r, p, h) in zip(told.frames, changed, strict=True)
        ]
        return replace(told, frames=frames)

    return spoil


def _each(change: Callable[[Frame], Frame]) -> Callable[[Told], Told]:
    return lambda told: replace(told, frames=[change(frame) for frame in told.frames])


def _height(change: Callable[[float], float]) -> Callable[[Told], Told]:
    return _each(lambda f: f if f.height_agl_m is None else replace(f, height_agl_m=max(change(f.height_agl_m), 1.0)))


def _late(seconds: float, *, attitude: bool = True, rest: bool = True) -> Callable[[Told], Told]:
    """Telemetry of some time ago; of its parts, the attitude or the rest."""

    def spoil(told: Told) -> Told:
        time_s = np.array([(f.timestamp_ns or 0) * 1e-9 for f in told.frames])
        columns = {}
        for name in (("roll_deg", "pitch_deg", "heading_deg") if attitude else ()) + (
            ("height_agl_m", "east_velocity_mps", "north_velocity_mps") if rest else ()
        ):
            values = [getattr(f, name) for f in told.frames]
            if None in values:
                continue
            column = np.array(values, np.float64)
            if name == "heading_deg":
                column = np.degrees(np.unwrap(np.radians(column)))
            column = np.interp(time_s - seconds, time_s, column)
            columns[name] = column % 360.0 if name == "heading_deg" else column
        frames = [
            replace(f, **{name: float(column[k]) for name, column in columns.items()})
            for k, f in enumerate(told.frames)
        ]
        return replace(told, frames=frames)

    return spoil


def _velocity(change: Callable[[float, float], tuple[float, float]]) -> Callable[[Told], Told]:
    def one(frame: Frame) -> Frame:
        if frame.east_velocity_mps is None or frame.north_velocity_mps is None:
            return frame
        east, north = change(frame.east_velocity_mps, frame.north_velocity_mps)
        return replace(frame, east_velocity_mps=east, north_velocity_mps=north)

    return _each(one)


def _stamps(factor: float) -> Callable[[Told], Told]:
    """Stamps in another unit, or of another frame rate; the truth keeps its own, by position in the list."""

    def spoil(told: Told) -> Told:
        first = told.frames[0].timestamp_ns or 0
        frames = [
            replace(f, timestamp_ns=round(first * min(factor, 1.0) + ((f.timestamp_ns or 0) - first) * factor))
            for f in told.frames
        ]
        return replace(told, frames=frames)

    return spoil


# ------------------------------------------------------------------------------------------------- camera


def _lens(focal: float = 1.0, principal_px: float = 0.0) -> Callable[[Told], Told]:
    def spoil(told: Told) -> Told:
        matrix = told.camera.matrix.copy()
        matrix[[0, 1], [0, 1]] *= focal
        matrix[:2, 2] += principal_px
        return replace(told, camera=replace(told.camera, matrix=matrix))

    return spoil


def _mounted(turn_deg: float = 0.0, tilt_deg: float = 0.0) -> Callable[[Told], Told]:
    """The calibration's mount turned about the optical axis, and tilted about the body's right axis."""

    def spoil(told: Told) -> Told:
        about_axis = cv2.Rodrigues(np.array([0.0, 0.0, np.radians(turn_deg)]))[0]
        about_right = cv2.Rodrigues(np.array([0.0, np.radians(tilt_deg), 0.0]))[0]
        return replace(told, camera=replace(told.camera, mount=about_right @ told.camera.mount @ about_axis))

    return spoil


def _pictures(change: Callable[[Array], Array]) -> Callable[[Told], Told]:
    return _each(lambda f: replace(f, image=np.ascontiguousarray(change(np.asarray(f.image)))))


def _distorted(k1: float) -> Callable[[Told], Told]:
    """Pictures of a lens with distortion, whose calibration says that it has none."""

    def spoil(told: Told) -> Told:
        camera = told.camera
        grid = np.stack(np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px)), -1).reshape(-1, 1, 2)
        flat = cv2.undistortPoints(grid.astype(np.float64), camera.matrix, np.array([k1, 0, 0, 0, 0]))
        there = flat.reshape(-1, 2) * camera.matrix[[0, 1], [0, 1]] + camera.matrix[:2, 2]
        lattice = there.reshape(camera.height_px, camera.width_px, 2).astype(np.float32)
        return _pictures(
            lambda image: cv2.remap(image, lattice, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        )(told)

    return spoil


def _rolling(readout_ms: float) -> Callable[[Told], Told]:
    """Rows read one after the other: the picture shears by the vehicle's own motion."""

    def spoil(told: Told) -> Told:
        frames = []
        for f in told.frames:
            speed = np.array([f.east_velocity_mps or 0.0, f.north_velocity_mps or 0.0])
            heading = np.radians(f.heading_deg or 0.0)
            along = speed @ [np.sin(heading), np.cos(heading)], speed @ [np.cos(heading), -np.sin(heading)]
            px_per_s = told.camera.focal_px / (f.height_agl_m or 100.0)
            dy, dx = along[0] * px_per_s * readout_ms * 1e-3, -along[1] * px_per_s * readout_ms * 1e-3
            height = told.camera.height_px
            shear = np.array([[1.0, dx / height, -dx / 2], [0.0, 1.0 + dy / height, -dy / 2]])
            image = cv2.warpAffine(
                np.asarray(f.image), shear, (told.camera.width_px, height), borderMode=cv2.BORDER_REFLECT
            )
            frames.append(replace(f, image=np.ascontiguousarray(image)))
        return replace(told, frames=frames)

    return spoil


def _frozen(every_s: float, for_s: float) -> Callable[[Told], Told]:
    def spoil(told: Told) -> Told:
        frames, held, first = [], None, told.frames[0].timestamp_ns or 0
        for f in told.frames:
            is_frozen = ((f.timestamp_ns or 0) - first) * 1e-9 % every_s >= every_s - for_s
            held = held if is_frozen and held is not None else f.image
            frames.append(replace(f, image=held))
        return replace(told, frames=frames)

    return spoil


def _kept(every: int) -> Callable[[Told], Told]:
    return lambda told: replace(told, frames=told.frames[::every])


# -------------------------------------------------------------------------------------------- map, surface


def _ground(
    shift_m: tuple[float, float] = (0.0, 0.0), scale: float = 1.0, turn_deg: float = 0.0, *, surface: str = "both"
) -> Callable[[Told], Told]:
    """What the map shows, moved on its own grid; with its surface model, without it, or that alone."""

    def spoil(told: Told) -> Told:
        height, width = told.gray.shape
        gsd = float(abs(told.affine[0, 0]))
        matrix = cv2.getRotationMatrix2D((width / 2.0, height / 2.0), -turn_deg, scale)
        matrix[:, 2] += np.array([shift_m[0], -shift_m[1]]) / gsd
        gray, heights = told.gray, told.surface_m
        if surface != "only":
            gray = cv2.warpAffine(gray, matrix, (width, height), borderMode=cv2.BORDER_REFLECT)
        if heights is not None and surface != "none":
            heights = cv2.warpAffine(heights, matrix, (width, height), borderMode=cv2.BORDER_REPLICATE)
        return replace(told, gray=np.ascontiguousarray(gray), surface_m=heights)

    return spoil


def _heights(change: Callable[[Array], Array]) -> Callable[[Told], Told]:
    return lambda told: told if told.surface_m is None else replace(told, surface_m=change(told.surface_m))


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
    spoil: Callable[[Told], Told]


def faults() -> list[Fault]:
    """All of them, by what they are of."""
    rows: list[Fault] = [Fault("none", (), lambda told: told)]

    def add(name: str, causes: str, **sizes: Callable[[Told], Told]) -> None:
        for size, spoil in sizes.items():
            label = size.strip("_").replace("_", " ")
            rows.append(Fault(f"{name}{' ' + label if label else ''}", tuple(causes.split()), spoil))

    add("angles in radians:", "radians", all=_angles(np.radians), heading=_angles(lambda a: a * [1, 1, np.pi / 180]),
        tilt=_angles(lambda a: a * [np.pi / 180, np.pi / 180, 1]))
    add("angles in degrees taken for radians", "degrees", _=_angles(lambda a: np.degrees(a)))
    add("roll and pitch swapped", "swapped", _=_angles(lambda a: a[:, [1, 0, 2]]))
    add("sign turned:", "sign", both=_angles(lambda a: a * [-1, -1, 1]), roll=_angles(lambda a: a * [-1, 1, 1]),
        pitch=_angles(lambda a: a * [1, -1, 1]))
    add("heading", "heading", off_3=_angles(lambda a: a + [0, 0, 3.0]), off_8=_angles(lambda a: a + [0, 0, 8.0]),
        off_20=_angles(lambda a: a + [0, 0, 20.0]))
    add("heading", "heading_convention", counter_clockwise=_angles(lambda a: a * [1, 1, -1]),
        from_east=_angles(lambda a: a * [1, 1, -1] + [0, 0, 90.0]))
    add("roll and pitch off", "tilt mount", by_2=_angles(lambda a: a + [2.0, 2.0, 0]),
        by_5=_angles(lambda a: a + [5.0, -5.0, 0]))
    add("height", "height", plus_10=_height(lambda h: h + 10), plus_20=_height(lambda h: h + 20),
        minus_20=_height(lambda h: h - 20))
    add("height above sea level", "height", plus_50=_height(lambda h: h + 50), plus_200=_height(lambda h: h + 200))
    add("height in feet", "height height_feet", _=_height(lambda h: h * FEET))
    add("telemetry late by", "clock", _0_1_s=_late(0.1), _0_5_s=_late(0.5), _2_s=_late(2.0))
    add("attitude alone late by", "clock", _0_1_s=_late(0.1, rest=False), _0_3_s=_late(0.3, rest=False))
    add("velocity", "velocity", swapped=_velocity(lambda e, n: (n, e)), in_kmh=_velocity(lambda e, n: (3.6 * e, 3.6 * n)),
        reversed=_velocity(lambda e, n: (-e, -n)))
    add("stamps in", "stamps", milliseconds=_stamps(1e-6), microseconds=_stamps(1e-3))
    add("frame rate times", "stamps velocity", _1_5=_stamps(1 / 1.5), _0_5=_stamps(2.0))
    add("focal length", "focal height", _20_percent_short=_lens(0.8), _5_percent_short=_lens(0.95),
        _5_percent_long=_lens(1.05), _20_percent_long=_lens(1.2))
    add("principal point off by", "mount tilt", _10_px=_lens(principal_px=10.0), _30_px=_lens(principal_px=30.0))
    add("distortion missing, k1", "focal height", _minus_0_05=_distorted(-0.05), _minus_0_2=_distorted(-0.2))
    add("mount turned by", "mount heading", _90=_mounted(90.0), _180=_mounted(180.0), _3=_mounted(3.0))
    add("mount tilted by", "mount tilt", _3=_mounted(tilt_deg=3.0), _10=_mounted(tilt_deg=10.0))
    add("pictures", "mirrored", mirrored=_pictures(lambda i: i[:, ::-1]), upside_down_mirrored=_pictures(lambda i: i[::-1]))
    add("pictures turned by EXIF", "mount", _90=_pictures(lambda i: np.rot90(i) if i.shape[0] == i.shape[1] else i[::-1, ::-1]),
        _180=_pictures(lambda i: i[::-1, ::-1]))
    add("rolling shutter", "", _20_ms=_rolling(20.0), _60_ms=_rolling(60.0))
    add("pictures frozen", "frozen", _5_of_15_s=_frozen(15.0, 5.0), _2_of_6_s=_frozen(6.0, 2.0))
    add("every picture kept", "", of_3=_kept(3), of_10=_kept(10))
    add("map and surface shifted by", "map", _5_m=_ground((3.0, 4.0)), _8_m=_ground((8.0, 0.0)), _40_m=_ground((-32.0, 24.0)))
    add("map scaled by", "map_scale height focal", _2_percent=_ground(scale=1.02), _10_percent=_ground(scale=1.1))
    add("map turned by", "heading map_turn", _2=_ground(turn_deg=2.0), _5=_ground(turn_deg=5.0))
    add("surface shifted by", "surface", _10_m=_ground((6.0, 8.0), surface="only"), _30_m=_ground((-18.0, 24.0), surface="only"))
    add("surface", "surface height", inverted=_heights(lambda z: 2 * np.float32(np.nanpercentile(z, 20)) - z),
        in_feet=_heights(lambda z: z * np.float32(FEET)))
    return rows
