"""Photographs as a camera and a drone write them, with EXIF and XMP."""

from pathlib import Path

import numpy as np
from PIL import Image

TAKEN = "2024:05:06 07:08:09"


def write_pictures(folder: Path, grays: dict[str, int]) -> Path:
    """Write pictures of 8 x 6 px and one grey level each, by name, to a folder that is made; the folder."""
    folder.mkdir()
    for name, gray in grays.items():
        Image.new("RGB", (8, 6), (gray, gray, gray)).save(folder / name)
    return folder


def photograph(
    path: Path, taken=TAKEN, gps=(), subsec=None, offset=None, xmp="", *, tags=(), software=None, size_px=(32, 24)
) -> Path:
    """Write a JPEG.

    Args:
        path: the file.
        taken: DateTimeOriginal.
        gps: tags of the position by number.
        subsec: SubSecTimeOriginal.
        offset: OffsetTimeOriginal.
        xmp: attributes of DJI's description.
        tags: further tags of the camera by number.
        software: what wrote the file.
        size_px: width and height.
    """
    exif = Image.Exif()
    details = {0x9003: taken, 0x9291: subsec, 0x9011: offset}
    exif.get_ifd(0x8769).update({key: value for key, value in details.items() if value is not None} | dict(tags))
    exif.get_ifd(0x8825).update(dict(gps))
    if software is not None:
        exif[0x0131] = software
    pixels = np.full((size_px[1], size_px[0], 3), 90, np.uint8)
    pixels[::2] += np.uint8(20)
    Image.fromarray(pixels).save(path, exif=exif)
    if xmp:
        body = b"http://ns.adobe.com/xap/1.0/\0" + f"<x:xmpmeta><rdf:Description {xmp}/></x:xmpmeta>".encode()
        content = path.read_bytes()
        path.write_bytes(content[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + content[2:])
    return path


def gimbal(roll="+0.00", pitch="-90.00", yaw="+30.00", flight_yaw="+10.00", height="+80.00") -> str:
    """DJI's XMP of a gimbal that looks down."""
    return (
        f'drone-dji:RelativeAltitude="{height}" drone-dji:GimbalRollDegree="{roll}" '
        f'drone-dji:GimbalPitchDegree="{pitch}" drone-dji:GimbalYawDegree="{yaw}" '
        f'drone-dji:FlightYawDegree="{flight_yaw}"'
    )
