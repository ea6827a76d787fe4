"""The package for colcon."""

from glob import glob

from setuptools import setup

NAME = "scenematch_ros"
SHARE = f"share/{NAME}"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (SHARE, ["package.xml"]),
        *((f"{SHARE}/{folder}", glob(f"{folder}/*")) for folder in ("config", "launch", "worlds")),
        (f"{SHARE}/models/iris_with_nadir_camera", glob("models/iris_with_nadir_camera/*")),
    ],
    install_requires=["setuptools", "scenematch-engine"],
    zip_safe=True,
    maintainer="scenematch",
    maintainer_email="scenematch@example.org",
    description="Positions from a downward camera and a map, without GNSS.",
    license="Apache-2.0",
    entry_points={"console_scripts": [f"node = {NAME}.node:main", f"truth = {NAME}.truth:main"]},
)
