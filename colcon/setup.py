"""Build s2a_bench as an ament_python package. What it consists of stands in ../pyproject.toml, which pip reads itself.

colcon runs this with the system's setuptools, and those of Humble (59) and Jazzy (68) cannot read that file.
"""  # noqa: INP001

from pathlib import Path

from setuptools import find_packages, setup

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10, where colcon brings tomli
    import tomli as tomllib

# resolved, because `colcon build --symlink-install` runs this through a link
ROOT = Path(__file__).resolve().parent.parent
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT = PYPROJECT["project"]
VERSIONS = [line for line in (ROOT / "s2a_bench/__init__.py").read_text().splitlines() if "__version__ =" in line]

setup(
    name="s2a_bench",
    version=VERSIONS[0].split('"')[1],
    description=PROJECT["description"],
    packages=find_packages(include=PYPROJECT["tool"]["setuptools"]["packages"]["find"]["include"]),
    package_data=PYPROJECT["tool"]["setuptools"]["package-data"],
    install_requires=PROJECT["dependencies"],  # for `s2a-bench doctor`: colcon installs none of them
    extras_require=PROJECT["optional-dependencies"],
    entry_points={
        group: [f"{name} = {where}" for name, where in points.items()]
        for group, points in {"console_scripts": PROJECT["scripts"], **PROJECT["entry-points"]}.items()
    },
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/s2a_bench"]),
        ("share/s2a_bench", ["package.xml"]),
        ("share/s2a_bench/launch", ["launch/s2a_bench.launch.py"]),
    ],
    zip_safe=False,
)
