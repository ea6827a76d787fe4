#!/usr/bin/env python3
"""Drape a map over the ground of a Gazebo world: a mesh textured with the map, as model://map_ground.

The model's x is east, its y is north. There is one version for Gazebo classic and one for Gazebo Harmonic.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from engine import EngineError, OrthoMap
from scenematch.bridges.vehicle import NedOrigin, north_east_m

MODEL = """<?xml version="1.0"?>
<sdf version="{sdf}">
  <model name="map_ground">
    <static>true</static>
    <link name="link">
      <collision name="collision">
        <geometry>
          <plane>
            <normal>0 0 1</normal>
            <size>{width_m:.1f} {height_m:.1f}</size>
          </plane>
        </geometry>
      </collision>
      <visual name="visual">
        <cast_shadows>false</cast_shadows>
        <geometry>
          <mesh>
            <uri>model://map_ground/meshes/ground.obj</uri>
          </mesh>
        </geometry>{material}
      </visual>
    </link>
  </model>
</sdf>
"""
CONFIG = """<?xml version="1.0"?>
<model>
  <name>map_ground</name>
  <version>1.0</version>
  <sdf version="1.6">model.sdf</sdf>
  <sdf version="1.9">model-harmonic.sdf</sdf>
  <description>A map draped over the ground.</description>
</model>
"""
# Gazebo Harmonic ignores the mesh's material, so the picture is emissive.
GLOWING = """
        <material>
          <diffuse>0 0 0 1</diffuse>
          <specular>0 0 0 1</specular>
          <emissive>1 1 1 1</emissive>
          <pbr>
            <metal>
              <albedo_map>model://map_ground/materials/textures/map.png</albedo_map>
              <emissive_map>model://map_ground/materials/textures/map.png</emissive_map>
              <metalness>0</metalness>
              <roughness>1</roughness>
            </metal>
          </pbr>
        </material>"""
# Lit only by ambient light, it looks like the photograph.
MATERIAL = "newmtl ground\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nmap_Kd ../materials/textures/map.png\n"


def vertices(site: OrthoMap, step_px: int) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """The mesh: vertices (N, 3) in metres, texture coordinates (N, 2) in [0, 1] from the bottom left, shape.

    Metres are ArduPilot's, from the map's centre, so that the simulated vehicle's latitude is the map's.
    """
    columns, rows = (np.r_[np.arange(0, n, step_px), n] - 0.5 for n in (site.width_px, site.height_px))
    xy = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    lat, lon = site.geodetic_from_pixel(xy)
    origin = NedOrigin(site.frame.lat_deg, site.frame.lon_deg, 0.0)
    north_east = np.array([north_east_m(*place, origin, "ardupilot") for place in zip(lat, lon, strict=True)])
    up = site.surface_at(xy) - site.ground_m
    places = np.column_stack([north_east[:, 1], north_east[:, 0], up])
    in_picture = (xy + 0.5) / (site.width_px, site.height_px)
    return places, np.column_stack([in_picture[:, 0], 1.0 - in_picture[:, 1]]), (len(rows), len(columns))


def obj(places: np.ndarray, in_picture: np.ndarray, shape: tuple[int, int]) -> str:
    """The mesh as a Wavefront file; faces are counter-clockwise from above."""
    lines = ["mtllib ground.mtl", "o ground"]
    lines += [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in places]
    lines += [f"vt {u:.6f} {v:.6f}" for u, v in in_picture]
    lines += ["vn 0 0 1", "usemtl ground"]
    index = np.arange(1, len(places) + 1).reshape(shape)
    corners = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]  # rows go south
    for nw, sw, se, ne in zip(*(corner.ravel() for corner in corners), strict=True):
        lines += ["f " + " ".join(f"{k}/{k}/1" for k in face) for face in ((nw, sw, se), (nw, se, ne))]
    return "\n".join(lines) + "\n"


def write_ground(map_path: Path, surface: Path | None, models: Path, step_px: int) -> OrthoMap:
    """Write the model's folder."""
    import rasterio
    from PIL import Image

    site = OrthoMap.open(map_path, surface=surface)
    folder = models / "map_ground"
    for name in ("meshes", "materials/textures"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    with rasterio.open(map_path) as source:
        picture = np.moveaxis(source.read([1, 2, 3] if source.count >= 3 else [1]), 0, 2)
    if picture.shape[:2] != (site.height_px, site.width_px):
        raise SystemExit(
            f"{map_path}: expected a map on a metric grid, which needs no resampling when opened; "
            f"gdalwarp -t_srs {site.crs.to_string()} {map_path} metric.tif makes one"
        )
    Image.fromarray(picture.squeeze()).save(folder / "materials/textures/map.png")
    places, in_picture, shape = vertices(site, step_px)
    extent_m = np.ptp(places[:, :2], axis=0)
    for name, sdf, material in (("model.sdf", "1.6", ""), ("model-harmonic.sdf", "1.9", GLOWING)):
        text = MODEL.format(sdf=sdf, width_m=extent_m[0], height_m=extent_m[1], material=material)
        (folder / name).write_text(text, encoding="utf-8")
    (folder / "model.config").write_text(CONFIG, encoding="utf-8")
    (folder / "meshes/ground.obj").write_text(obj(places, in_picture, shape), encoding="utf-8")
    (folder / "meshes/ground.mtl").write_text(MATERIAL, encoding="utf-8")
    return site


def main() -> None:
    """Write the model, and print the world's origin for the launch files and SITL."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("map", type=Path, help="GeoTIFF of 8 bits")
    parser.add_argument("--surface", type=Path, help="surface model; without it the ground is flat")
    parser.add_argument("--models", type=Path, default=Path(__file__).parent / "models")
    parser.add_argument("--step-px", type=int, default=8, help="spacing of the mesh in map pixels")
    wanted = parser.parse_args()
    try:
        site = write_ground(wanted.map, wanted.surface, wanted.models, wanted.step_px)
    except (EngineError, OSError) as error:
        raise SystemExit(f"make_world.py: {error}") from None
    lat_lon = f"{site.frame.lat_deg:.7f},{site.frame.lon_deg:.7f}"
    print(f"origin:={lat_lon}")
    print(f"--custom-location={lat_lon},0,0")


if __name__ == "__main__":
    main()
