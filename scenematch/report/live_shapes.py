"""Shapes of the live view: convert the engine's values to rerun archetypes, and lay out the viewer."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from engine.geo import Array
from engine.orthomap import OrthoMap
from engine.values import Window
from scenematch.report.explain import SIDE_PX, Image, jpeg_bytes, level_within

SIGMAS = 3.0
"""Size of the ellipsoid about a fix, in standard deviations."""
FIX_RGB = (0, 158, 115)
"""Colour of fixes."""
_MAX_MAP_PX = 1024  # longer side of the map's texture
_MESH_SIDE = 17  # vertices per side of the map's mesh
_OUTLINE_OFFSET_M = 1.0  # of outlines above the ground
_PADDING_GREY = 238


def blueprint(site: OrthoMap) -> Any:
    """Layout of the viewer: the world on the left, the newest frame on the right, time series below."""
    all_times = rr.VisibleTimeRange(
        "frame", start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.cursor_relative()
    )
    side_m = min(float(max(site.width_px, site.height_px)) * site.gsd_m_per_px, 3000.0)
    eye = rrb.EyeControls3D(
        position=(0.0, -0.8 * side_m, site.ground_m + 0.8 * side_m), look_target=(0.0, 0.0, site.ground_m)
    )
    world = rrb.Spatial3DView(
        origin="world",
        name="World",
        eye_controls=eye,
        line_grid=False,
        overrides={"world/fixes": rrb.VisibleTimeRanges([all_times])},
    )
    names = {"frame": "Frame", "rectified": "Rectified", "window": "Window", "surface": "Correlation"}
    pictures = [rrb.Spatial2DView(origin=origin, name=name) for origin, name in names.items()]
    plots = [
        rrb.TimeSeriesView(origin=f"plots/{name}", name=text)
        for name, text in (("score", "Score"), ("sigma_m", "Sigma (m)"), ("latency_ms", "Latency (ms)"))
    ]
    state = rrb.StateTimelineView(origin="state", name="State")
    matches, words = rrb.Spatial2DView(origin="matches", name="Matches"), rrb.TextLogView(origin="log", name="Log")
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(world, rrb.Horizontal(*plots), state, row_shares=[6, 3, 2]),
            rrb.Vertical(rrb.Grid(*pictures, grid_columns=2), rrb.Tabs(words, matches), row_shares=[7, 4]),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(timeline="frame", state="collapsed"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
    )


def map_mesh(site: OrthoMap) -> Any:
    """The map as a textured mesh on its ground, in metres east, north and up."""
    level = level_within(site, max(site.level_shape(0)), _MAX_MAP_PX)
    rows, columns = site.level_shape(level)
    gray = site.gray(Window(0, 0, columns, rows), level)
    u, v = (a.ravel() for a in np.meshgrid(*2 * [np.linspace(0.0, 1.0, _MESH_SIDE)]))
    at_px = site.full_from_level(np.stack([u * columns, v * rows], axis=-1) - 0.5, level)
    heights = site.ground_m if not site.has_surface else [site.ground_at(xy) for xy in at_px]
    vertices = np.column_stack([site.enu_from_pixel(at_px), np.broadcast_to(heights, len(at_px))])
    first = np.arange(_MESH_SIDE * (_MESH_SIDE - 1)).reshape(_MESH_SIDE - 1, _MESH_SIDE)[:, :-1].ravel()
    a, b, c, d = first, first + 1, first + _MESH_SIDE, first + _MESH_SIDE + 1
    triangles = np.concatenate([np.stack([a, c, b], axis=-1), np.stack([b, c, d], axis=-1)])
    texture = np.repeat(gray[:, :, None], 3, axis=2)
    return rr.Mesh3D(
        vertex_positions=vertices,
        triangle_indices=triangles,
        vertex_texcoords=np.stack([u, v], axis=-1),
        albedo_texture=texture,
    )


def ellipsoid(center_m: Array, covariance_m2: Array) -> Any:
    """The error ellipsoid of :data:`SIGMAS` about a position (3,), by its covariance (3, 3)."""
    variances, axes = np.linalg.eigh(covariance_m2)
    axes[:, 0] *= np.sign(np.linalg.det(axes))  # a rotation, not a reflection
    rotation = cv2.Rodrigues(axes)[0].ravel()
    angle = float(np.linalg.norm(rotation))
    axis = rotation / angle if angle > 0.0 else np.array([0.0, 0.0, 1.0])
    return rr.Ellipsoids3D(
        half_sizes=[SIGMAS * np.sqrt(np.maximum(variances, 0.0))],
        centers=[center_m],
        rotation_axis_angles=[rr.RotationAxisAngle(axis=axis, radians=angle)],
        colors=FIX_RGB,
    )


def outline(site: OrthoMap, corners_px: Array, colour: tuple[int, int, int]) -> Any:
    """A closed line above the surface through map pixels (4, 2)."""
    strip = np.column_stack([site.enu_from_pixel(corners_px), site.surface_at(corners_px) + _OUTLINE_OFFSET_M])
    return rr.LineStrips3D([closed_polyline(strip)], colors=colour, radii=rr.Radius.ui_points(1.0))


def corners(window: Window) -> Array:
    """Corners (4, 2) of a window in map pixels, at the outer edges of its pixels."""
    width, height = window.width_px, window.height_px
    sides = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float64)
    return np.asarray(sides + np.array([window.x0, window.y0]) - 0.5, np.float64)


def closed_polyline(points: Array) -> Array:
    """Points (N, ...) with the first appended, (N + 1, ...)."""
    return np.asarray(np.concatenate([points, points[:1]]), np.float64)


def jpeg(image: Image) -> Any:
    """An image (H, W) grey or (H, W, 3) RGB as JPEG."""
    return rr.EncodedImage(contents=jpeg_bytes(image, 80), media_type="image/jpeg")


def padded(image: Image, width_px: int = SIDE_PX) -> Image:
    """Pad an image below and on the right: the viewer requires one size for all images of an entity."""
    down, right = max(0, SIDE_PX - image.shape[0]), max(0, width_px - image.shape[1])
    full = cv2.copyMakeBorder(image, 0, down, 0, right, cv2.BORDER_CONSTANT, value=3 * [_PADDING_GREY])
    return np.asarray(full[:SIDE_PX, :width_px], np.uint8)
