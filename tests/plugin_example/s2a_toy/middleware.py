"""A middleware `toy-dds`: Cyclone DDS by another name. Light to import, as it is read where nothing is installed."""

from s2a_bench.ros import MiddlewareKind

TOY_DDS = MiddlewareKind(
    opens="s2a_bench.ros.cyclone:CycloneMiddleware",
    module="cyclonedds",
    way_out="it has wheels for x86-64 only",
    dds="cyclonedds",
)
