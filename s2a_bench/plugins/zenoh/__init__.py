"""The middleware on Zenoh from PyPI, as rmw_zenoh speaks it; its nodes meet at a router."""

from s2a_bench.extras import how_to_install
from s2a_bench.plugins.zenoh.router import ROUTER, endpoint_of, to_host
from s2a_bench.ros import MeetingPlace, MiddlewareKind

EXTRA = "ROS 2 over Zenoh, as rmw_zenoh speaks it"
ZENOH = MiddlewareKind(
    "s2a_bench.plugins.zenoh.middleware:ZenohMiddleware",
    "zenoh",
    f"{how_to_install('zenoh')}, or use --middleware cyclonedds",
    "rmw_zenoh_cpp",
    meeting_place=MeetingPlace(
        "router",
        f"Zenoh's router, as {ROUTER}; a server starts it on loopback [default: one of the run's own]",
        "Zenoh router",
        ROUTER,
        check=endpoint_of,
        to_host=to_host,
    ),
    against_loss="--qos reliable: what is best effort is dropped where Zenoh's link is busy",
    extra="zenoh",
    packages=("eclipse-zenoh",),
    checks={"zenoh": "s2a_bench.plugins.zenoh.router:check"},
)
