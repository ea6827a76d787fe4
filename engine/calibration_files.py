"""Calibration files of ROS (camera_info), OpenCV (YAML, XML, JSON) and Kalibr (camchain), read as one mapping."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import yaml

from engine.errors import CalibrationError

_NAMES = {
    "image_width": ("image_Width", "imageWidth", "width"),
    "image_height": ("image_Height", "imageHeight", "height"),
    "camera_matrix": ("Camera_Matrix", "cameraMatrix", "K", "mtx"),
    "distortion_coefficients": ("Distortion_Coefficients", "distCoeffs", "dist_coeffs", "D", "dist"),
}
"""Fields of camera_info, each with the names that OpenCV's samples and tutorials use."""
_SIZES = ("image_size", "imageSize", "Image_Size", "resolution")
_KALIBR_MODELS = {"radtan": "plumb_bob", "equidistant": "equidistant", "none": "plumb_bob"}
_MAX_COEFFICIENTS = 8  # further ones describe a thin prism and a tilted sensor


def read_calibration(path: str | Path) -> dict[str, Any]:
    """Read the calibration of one camera.

    Args:
        path: a ROS camera_info YAML file; YAML, XML or JSON of OpenCV's FileStorage; or Kalibr's camchain.

    Returns:
        The fields by camera_info's names; fields that the file lacks are missing, others stay unchanged.

    Raises:
        CalibrationError: the file is missing, in none of these formats, or of several cameras.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
        content = _from_xml(text) if text.lstrip().startswith("<") else yaml.load(_plain_yaml(text), _Loader)
    except FileNotFoundError:
        raise CalibrationError(f"camera: no such file: {path}") from None
    except (OSError, UnicodeDecodeError, SyntaxError, yaml.YAMLError) as error:
        reason = str(error).splitlines()[0]
        kind = "XML" if isinstance(error, SyntaxError) else "YAML"
        raise CalibrationError(f"camera: {path} is not a readable {kind} file: {reason}") from None
    if not isinstance(content, dict):
        raise CalibrationError(f"camera: {path} holds no camera_info mapping")
    try:
        return _from_kalibr(content) if _cameras(content) else _from_opencv(content)
    except CalibrationError as error:
        raise CalibrationError(f"camera: {path}: {error}") from None


class _Loader(yaml.SafeLoader):
    """YAML with OpenCV's matrices, which are mappings with a tag."""


for _tag in ("opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", partial(_Loader.construct_mapping, deep=True))


def _plain_yaml(text: str) -> str:
    """Drop OpenCV's first line ``%YAML:1.0``, which is not a valid YAML directive."""
    return text.split("\n", 1)[1] if text.startswith("%YAML:") and "\n" in text else text


def _from_xml(text: str) -> Any:
    """Elements as a mapping: text becomes a number or a word, a matrix's ``data`` a list of numbers."""
    from xml.etree import ElementTree

    def value(element: ElementTree.Element) -> Any:
        if len(element):
            return {child.tag: value(child) for child in element}
        words = (element.text or "").split()
        if element.tag == "data" or len(words) > 1:
            return words
        return yaml.safe_load(words[0]) if words else None

    return value(ElementTree.fromstring(text))


def _from_opencv(content: dict[str, Any]) -> dict[str, Any]:
    info = dict(content)
    for name, others in _NAMES.items():
        found = next((other for other in others if other in content), None)
        if name not in content and found is not None:
            info[name] = info.pop(found)
    size = next((_list(content[name]) for name in _SIZES if name in content), [])
    if len(size) == 2 and "image_width" not in info and "image_height" not in info:
        info["image_width"], info["image_height"] = (int(n) if str(n).isdecimal() else n for n in size)
    coefficients = _list(info.get("distortion_coefficients"))
    if "distortion_model" not in info:
        info["distortion_model"] = _model_of_opencv(content.get("fisheye_model"), len(coefficients))
    more = coefficients[_MAX_COEFFICIENTS:]
    if more:
        if any(str(value).strip(" 0.+-") for value in more):
            raise CalibrationError(
                "distortion_coefficients: expected 4, 5 or 8 numbers, got "
                f"{len(coefficients)}, a thin prism or a tilted sensor"
            )
        info["distortion_coefficients"] = coefficients[:_MAX_COEFFICIENTS]
    return info


def _list(value: Any) -> list[Any]:
    """The numbers of a matrix or a list; (1, N) and (N, 1) become one list."""
    if isinstance(value, dict):
        value = value.get("data")
    if not isinstance(value, list):
        return []
    return [number for row in value for number in (row if isinstance(row, list) else [row])]


def _model_of_opencv(fisheye: Any, coefficients: int) -> str:
    if fisheye is not None and str(fisheye).lower() in ("1", "true"):
        return "fisheye"
    return "rational_polynomial" if coefficients > 5 else "plumb_bob"


def _cameras(content: dict[str, Any]) -> list[str]:
    """Kalibr's names of its cameras."""
    return [
        name for name, block in content.items()
        if isinstance(block, dict) and str(name).startswith("cam") and "intrinsics" in block
    ]  # fmt: skip


def _from_kalibr(content: dict[str, Any]) -> dict[str, Any]:
    names = _cameras(content)
    if len(names) > 1:
        raise CalibrationError(
            f"expected one camera, got {', '.join(names)}: keep the block of the downward camera"
        )
    block = content[names[0]]
    kind, model = block.get("camera_model", "pinhole"), str(block.get("distortion_model", "none"))
    if kind != "pinhole":
        raise CalibrationError(f"{names[0]}: camera_model: expected pinhole, got {kind!r}")
    if model not in _KALIBR_MODELS:
        known = ", ".join(_KALIBR_MODELS)
        raise CalibrationError(f"{names[0]}: distortion_model: expected one of {known}, got {model!r}")
    for name, count in (("intrinsics", 4), ("resolution", 2)):
        if len(_list(block.get(name))) != count:
            raise CalibrationError(f"{names[0]}: {name}: expected {count} numbers, got {block.get(name)!r}")
    (fx, fy, cx, cy), (width_px, height_px) = block["intrinsics"], block["resolution"]
    mount = {
        key: where[key] for where in (block, content) for key in ("mount", "camera_pitch_deg") if key in where
    }
    return mount | {
        "image_width": width_px,
        "image_height": height_px,
        "camera_matrix": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        "distortion_model": _KALIBR_MODELS[model],
        "distortion_coefficients": block.get("distortion_coeffs", []),
    }
