"""The middleware of a ROS 2 that is installed: rclpy and its RMW."""

from s2a_bench.ros import MiddlewareKind

RCLPY = MiddlewareKind(
    "s2a_bench.plugins.rclpy.middleware:RclpyMiddleware",
    "rclpy",
    "it comes with ROS 2: source /opt/ros/<distribution>/setup.bash, or use --middleware cyclonedds",
    dds="",
    has_action="s2a_bench.plugins.rclpy.types:has_action",
)
