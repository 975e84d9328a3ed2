"""highway-env's road and vehicles as this scenario uses them: a straight road of two lanes, cars 5 m long."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from s2a_bench import extras
from s2a_bench.scenario import EGO, LEAD, REAR

if TYPE_CHECKING:
    from s2a_bench.policy import Floats

ROAD_M: Final = 5000.0
BEHIND_M: Final = 500.0
LANE_WIDTH_M: Final = 4.0
LANES: Final = {0: 1, 1: 0}
"""Our lane, 0 where all start and 1 to its left -> highway-env's, which counts from the left."""
MIDDLE_M: Final = LANE_WIDTH_M * LANES[0]
"""Where our lane's middle lies on highway-env's y axis, which points to the right."""
LENGTHS: Final = {LEAD: 1.0, EGO: 0.0, REAR: -1.0}
"""By how many car lengths a centre lies ahead of our positions, which are bumper to bumper."""


def build_road() -> Any:
    """Make a straight road of two lanes; raises MissingExtra without highway-env."""
    # A fixed source of randomness: nothing on this road draws from it, but without one it would be seeded anew.
    import numpy as np

    made_of = extras.require("highway_env.road.road", "ccrb")
    straight = made_of.RoadNetwork.straight_road_network
    network = straight(len(LANES), start=-BEHIND_M, length=ROAD_M + BEHIND_M, speed_limit=50.0)
    return made_of.Road(network, np_random=np.random.RandomState(0), record_history=False)


def centre(car: int, position_m: float, lateral_m: float, length_m: float) -> Floats:
    """Return highway-env's coordinates of a car, in m."""
    import numpy as np

    return np.array([position_m + LENGTHS[car] * length_m, MIDDLE_M - lateral_m])


def lane_index(lane: int) -> tuple[str, str, int]:
    """Return highway-env's name of a lane."""
    return ("0", "1", LANES[lane])
