"""A ROS 2 package of launch files, without code of its own."""

from glob import glob
from xml.etree import ElementTree

from setuptools import setup

NAME = "tod_runner_launch"

setup(
    name=NAME,
    version=ElementTree.parse("package.xml").findtext("version"),
    packages=[],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", sorted(glob("launch/*.xml"))),
    ],
)
