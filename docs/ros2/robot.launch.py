"""Starts a wire, and a talker and a listener on different sides of it: `ros2 launch robot.launch.py`."""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import ExecuteProcess
from launch_ros.actions import Node

WIRE = Path(__file__).with_name("robot.toml")
SIDES = {"robot": "tcp/127.0.0.1:7448", "base": "tcp/127.0.0.1:7449"}


def environment(side: str) -> dict[str, str]:
    """The two variables that put a node on a side. A node that starts before the wire waits for it."""
    return {
        "RMW_IMPLEMENTATION": "rmw_zenoh_cpp",
        "ZENOH_CONFIG_OVERRIDE": f'mode="client";connect/endpoints=["{SIDES[side]}"];connect/timeout_ms=-1',
    }


def generate_launch_description() -> LaunchDescription:
    """The wire, and two nodes that know nothing of it."""
    return LaunchDescription(
        [
            # Without --out, each launch has its own folder and the same losses; with one, it would continue the last launch.
            ExecuteProcess(cmd=["evedrop", "wire", str(WIRE)], output="screen"),
            Node(package="demo_nodes_cpp", executable="talker", additional_env=environment("robot")),
            Node(package="demo_nodes_cpp", executable="listener", additional_env=environment("base")),
        ]
    )
