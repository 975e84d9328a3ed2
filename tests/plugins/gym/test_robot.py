"""A gymnasium environment as a robot: what it is given, what is seen of it, and how an episode went."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any, Final

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete

from s2a_bench.act import TaskKind, kind
from s2a_bench.errors import MissingExtra, RobotError, S2AError, UsageError
from s2a_bench.plugins.gym.robot import GymRobot

SPACES: Final[dict[str, gymnasium.Space[Any]]] = {
    "box": Box(np.array([-1, 2], np.float32), np.array([0.5, 4], np.float32)),
    "wide": Box(-9, 9, (2, 2), np.float64),
    "five": Discrete(5),
    "from three": Discrete(3, start=3),
    "signed": Discrete(3, start=-1),
    "dict": Dict({"arm": Box(-1, 1), "gripper": Discrete(2)}),
}
PIXELS: Final = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)


MADE = "cannot be made (a package first: env=PACKAGE:ID; no render_mode: picture=none)"


class Fake(gymnasium.Env[Any, Any]):
    """An environment that does what its keywords say, and keeps what it is given."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012 - as gymnasium declares it

    def __init__(
        self,
        *,
        space: str = "box",
        render_mode: str | None = None,
        said: Sequence[Any] = (),
        key: str = "is_success",
        ends: tuple[int, bool] = (10**6, False),
        raises: str = "",
        seeded: bool = True,
        nested: bool = False,
        drawn: str = "good",
        **facts: Any,
    ) -> None:
        self.action_space, self.render_mode = SPACES[space], render_mode
        self.said, self.key, self.ends, self.raises = said, key, ends, raises
        self.seeded, self.nested, self.drawn = seeded, nested, drawn
        self.given: list[Any] = []
        self.steps = 0
        self.metadata = {**self.metadata, **({"render_fps": facts.pop("fps")} if "fps" in facts else {})}
        vars(self).update(facts)
        self._fail("make")

    def _fail(self, where: str) -> None:
        if self.raises == where:
            raise ValueError(f"no {where}\ntoday")

    def _seen(self) -> Any:
        state = np.array([self.start, self.steps, self.steps**2, self.steps**3], np.float64)
        return {"agent": {"pos": state}, "pixels": PIXELS, "text": "hi"} if self.nested else state

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._fail("reset")
        super().reset(seed=seed, options=options)
        self.start = float((self.np_random if self.seeded else np.random.default_rng()).uniform())
        self.steps = 0
        return self._seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._fail("step")
        self.given.append(action)
        info = {self.key: self.said[self.steps]} if self.steps < len(self.said) else {}
        self.steps += 1
        at, terminates = self.ends
        return self._seen(), 0.5, self.steps == at and terminates, self.steps == at and not terminates, info

    def render(self) -> Any:
        return {"good": PIXELS, "float": PIXELS / 255, "grey": PIXELS[..., 0], "none": None}[self.drawn]


gymnasium.register("Fake-v0", Fake)


def written(**parameters: object) -> str:
    given = {"env": "Fake-v0", "picture": "none", "success": "survival", **parameters}
    return "gym?" + "&".join(f"{name}={value}" for name, value in given.items())


def robot(*, period_ns: int = 20_000_000, **parameters: object) -> GymRobot:
    made = kind(written(tau=0.02, **parameters), TaskKind).open_actions(0, period_ns)
    assert isinstance(made, GymRobot)
    made.begin(0)
    return made


def fake(of: GymRobot) -> Fake:
    env = of._env.unwrapped
    assert isinstance(env, Fake)
    return env


def sent(of: GymRobot, *actions: Sequence[float] | None) -> list[Any]:
    """Return what the environment gets for each action."""
    for action in actions:
        of.send(None if action is None else np.array(action, np.float32), 0)
    return fake(of).given


def test_a_box_gets_actions_within_its_bounds_and_of_its_type_and_shape() -> None:
    first, second = sent(robot(space="box"), [0.25, 3], [-7, 7])
    assert (first.dtype, first.tolist()) == (np.float32, [0.25, 3])
    assert second.tolist() == [-1, 4]
    (wide,) = sent(robot(space="wide"), [1, 2, 3, 40])
    assert (wide.dtype, wide.tolist()) == (np.float64, [[1, 2], [3, 9]])


@pytest.mark.parametrize(
    ("space", "indices"), [("five", [0, 1, 2, 4]), ("from three", [3, 3, 3, 5]), ("signed", [-1, 1, 1, 1])]
)
def test_a_discrete_space_gets_the_nearest_of_its_indices(space: str, indices: list[int]) -> None:
    given = sent(robot(space=space), [-3.0], [0.6], [2.4], [99.0])
    assert given == indices
    assert {type(each) for each in given} == {int}


@pytest.mark.parametrize(("space", "rest"), [("box", [0, 2]), ("from three", 3), ("signed", 0)])
def test_before_its_first_action_it_takes_the_one_nearest_to_zero(space: str, rest: Any) -> None:
    assert np.array_equal(sent(robot(space=space), None)[0], rest)


@pytest.mark.parametrize(("stall", "then"), [("repeat", [0.5, 3]), ("neutral", [0, 2])])
def test_in_a_stall_it_repeats_its_action_or_takes_the_neutral_one(stall: str, then: list[float]) -> None:
    made = robot(stall=stall)
    assert [each.tolist() for each in sent(made, [0.5, 3], None)] == [[0.5, 3], then]
    made.begin(1)
    assert sent(made, None)[-1].tolist() == [0, 2]  # of the last episode nothing is repeated


def test_the_state_is_the_observation_or_what_it_has_at_a_key() -> None:
    whole = robot().state()
    assert list(whole) == [float(np.float32(fake(robot()).start)), 0, 0, 0]
    assert robot(nested=True, state="agent.pos").state() == whole
    assert robot(state="none").state() == ()


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ("", "state: name a key of the observation: agent, pixels, text, or none"),
        ("arm", "the observation of Fake-v0 has no 'arm'; it has agent, pixels, text"),
        ("agent.vel", "the observation of Fake-v0 has no 'agent.vel'; it has pos"),
        ("agent.pos.x", "the observation of Fake-v0 has no 'agent.pos.x'"),
        ("pixels", "the state: shape (4, 6, 3) and type uint8, not numbers of shape (D,); name a key of the obs"),
        ("text", "the state: shape (1,) and type <U2, not numbers of shape (D,); name a key of the observation"),
    ],
)
def test_what_is_no_state_is_one_line(state: str, message: str) -> None:
    with pytest.raises(RobotError) as error:
        robot(nested=True, state=state)
    assert str(error.value).startswith(f"`robot`: gym: {message}")


def test_the_picture_is_rendered_or_at_a_key_or_none() -> None:
    for made in (robot(picture="render"), robot(picture="pixels", nested=True, state="agent.pos")):
        pixels = made.picture()
        assert pixels is not None
        assert np.array_equal(pixels, PIXELS)
        assert pixels is not PIXELS  # the environment may draw on it again
    assert robot().picture() is None
    assert fake(robot()).render_mode is None


@pytest.mark.parametrize(
    ("picture", "drawn", "message"),
    [
        ("agent.pos", "", "picture: agent.pos is float64 (4,), not uint8 (h, w, 3)"),
        ("render", "float", "picture: render is float64 (4, 6, 3), not uint8 (h, w, 3)"),
        ("render", "grey", "picture: render is uint8 (4, 6), not uint8 (h, w, 3)"),
        ("render", "none", "picture: render is object (), not uint8 (h, w, 3)"),
        ("render", "late", "Fake-v0 cannot be rendered (picture=none does without): KeyError: 'late'"),
    ],
)
def test_what_is_no_picture_is_one_line(picture: str, drawn: str, message: str) -> None:
    with pytest.raises(RobotError) as error:
        robot(nested=True, state="agent.pos", picture=picture, drawn=drawn).picture()
    assert str(error.value) == f"`robot`: gym: {message}"


@pytest.mark.parametrize(
    ("parameters", "ends_after", "success"),
    [
        ({"success": "info", "said": (False, True, False)}, 2, True),
        ({"success": "info", "said": (0.0, 0.0, 1.0), "key": "success"}, 3, True),
        ({"success": "info", "said": (0.0,) * 4, "key": "success", "ends": (4, False)}, 4, False),
        ({"success": "terminated", "ends": (3, True)}, 3, True),
        ({"success": "terminated", "ends": (3, False)}, 3, False),
        ({"success": "survival", "ends": (3, True)}, 3, False),
        ({"success": "survival", "ends": (3, False)}, 3, True),
        ({"success": "survival", "said": (True, True, True, True), "ends": (4, False)}, 4, True),
        ({"success": "return", "least": 1.5, "ends": (3, True)}, 3, True),
        ({"success": "return", "least": 1.6, "ends": (3, True)}, 3, False),
        ({"success": "survival", "max_episode_steps": 5}, 5, True),
    ],
)
def test_an_episode_ends_with_the_environment_s_or_at_the_success_that_is_asked_for(
    parameters: dict[str, Any], ends_after: int, success: bool
) -> None:
    made = robot(**parameters)
    over = []
    for _ in range(ends_after):
        made.send(None, 0)
        over.append(made.over)
    assert over == [False] * (ends_after - 1) + [True]
    assert made.outcome().success is success
    assert made.outcome().reward == 0.5 * ends_after
    made.send(None, 0)
    assert (made.over, made.outcome().reward) == (False, 0.5)  # another episode
    start = fake(made).start
    made.begin(1)
    assert fake(made).start == start


def test_an_environment_that_says_nothing_of_success_is_told_the_rules() -> None:
    made = robot(success="info")
    sent(made, None)
    with pytest.raises(RobotError, match=r"info has none of is_success, success\); add success=survival, success=ter"):
        made.outcome()


@pytest.mark.parametrize(
    ("facts", "period_ns", "of"),
    [
        ({"dt": 0.0125, "tau": 0.02, "fps": 10}, 12_500_000, "12.5 ms, of dt"),
        ({"tau": 0.02, "fps": 10}, 20_000_000, "20 ms, of tau"),
        ({"fps": 30}, 33_333_333, "33.3333 ms, of render_fps"),
        ({"dt": None, "fps": 50}, 20_000_000, "20 ms, of render_fps"),
    ],
)
def test_the_period_is_the_environment_s_and_said_of_which_name(facts: dict[str, Any], period_ns: int, of: str) -> None:
    made = kind(written(**facts), TaskKind)
    assert made.period_ns == period_ns
    assert made.open_actions(0, period_ns).describe()["period"] == of
    assert made.open_actions(0, 1_000_000).describe()["period"] == f"1 ms, of control_hz, not {of}"


def test_an_environment_without_a_period_asks_for_the_rate() -> None:
    with pytest.raises(UsageError, match=r"^`control_hz`: Fake-v0 names no period \(dt, tau, render_fps\)"):
        _ = kind(written(), TaskKind).period_ns


def test_an_environment_without_a_period_takes_the_rate_that_is_given() -> None:
    made = kind(written(), TaskKind).open_actions(0, 20_000_000)
    assert made.describe()["period"] == "20 ms, of control_hz"


def test_the_period_may_be_a_number_of_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Fake, "dt", np.float32(0.25), raising=False)
    assert kind(written(), TaskKind).period_ns == 250_000_000


def test_other_parameters_are_keywords_with_python_s_literals() -> None:
    made = robot(a="3", b="(1,.5)", c="None", d="push-v3", e="'4'", f="{'x':[1]}", g="")
    values = [getattr(fake(made), name) for name in "abcdefg"]
    assert values == [3, (1, 0.5), None, "push-v3", "4", {"x": [1]}, ""]
    facts = made.describe()
    assert (facts["robot"], facts["env"], facts["success"]) == ("gym", "Fake-v0", "survival")
    assert "d=push-v3" in facts["keywords"].split("&")


def test_keywords_named_as_facts_are_still_told_apart() -> None:
    facts = robot(robot="panda", period=7).describe()
    assert facts["robot"] == "gym"
    assert facts["period"] == "20 ms, of tau"
    assert facts["keywords"] == "tau=0.02&robot=panda&period=7"


def test_path_and_jerk_are_those_of_the_actions_or_of_a_position() -> None:
    acted = robot(space="wide", period_ns=500_000_000)
    sent(acted, *([0, 0, 0, tick**3 / 8] for tick in range(5)))  # third difference 6 / 8 by .5^3
    assert acted.outcome().path == pytest.approx(8)
    assert acted.outcome().jerk == pytest.approx(6 / np.sqrt(4))  # of four axes, one moves
    moved = robot(position="state[1:4]", period_ns=100_000_000)
    sent(moved, *[None] * 4)  # (n, n^2, n^3) at 1 to 4
    ways = [(1, 3, 7), (1, 5, 19), (1, 7, 37)]
    assert moved.outcome().path == pytest.approx(sum(np.linalg.norm(way) for way in ways))
    assert moved.outcome().jerk == pytest.approx(6e3 / np.sqrt(3))
    sent(short := robot(space="wide"), [0] * 4, [1] * 4, [3] * 4)
    assert [short.outcome().path, short.outcome().jerk] == pytest.approx([6, 0])


@pytest.mark.parametrize("parameters", [{"position": "state[7:9]"}, {"position": "state[0:2]", "state": "none"}])
def test_a_position_that_the_state_does_not_have_is_refused(parameters: dict[str, Any]) -> None:
    with pytest.raises(S2AError):
        sent(robot(**parameters), None, None)


def test_the_same_seed_is_the_same_start_and_another_is_another() -> None:
    made = robot()
    starts = []
    for seed in (3, 4, 3):
        made.begin(seed)
        starts.append(made.state())
    assert starts[0] == starts[2] != starts[1]


def test_a_seed_method_of_older_environments_is_called() -> None:
    seeds: list[int] = []
    made = robot()
    fake(made).seed = seeds.append  # type: ignore[attr-defined]
    made.begin(7)
    assert seeds == [7]


def test_an_environment_that_ignores_its_seed_is_refused() -> None:
    with pytest.raises(RobotError, match="Fake-v0 begins differently with the same seed: rows would not compare"):
        robot(seeded=False)


def test_an_environment_that_ignores_its_seed_is_refused_without_a_state_too() -> None:
    with pytest.raises(RobotError, match="begins differently with the same seed"):
        robot(seeded=False, state="none")


def make(**parameters: object) -> Callable[[], object]:
    return lambda: robot(**parameters)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("called", "kind_of", "message"),
    [
        (
            make(raises="make"),
            UsageError,
            rf"Fake-v0 {MADE}: ValueError: no make\n",
        ),
        (make(raises="reset"), RobotError, r"Fake-v0 cannot be reset: ValueError: no reset\ntoday"),
        (lambda: sent(robot(raises="step"), None), RobotError, r"Fake-v0 raised: ValueError: no step\ntoday"),
        (lambda: sent(robot(), [1, 2, 3]), RobotError, "an action of shape (3,); Fake-v0 takes (2,)"),
        (
            make(env="NoSuch-v0"),
            UsageError,
            f"NoSuch-v0 {MADE}: NameNotFound",
        ),
        (make(env="no_such_package:A-v0"), UsageError, f"no_such_package:A-v0 {MADE}"),
        (make(space="dict"), UsageError, "Fake-v0 takes actions of Dict("),
        (lambda: kind("gym", TaskKind), UsageError, "env: name an environment, as in env=CartPole-v1"),
        (make(env=""), UsageError, "env: name an environment, as in env=CartPole-v1"),
        (make(position="state[a:b]"), UsageError, "position = 'state[a:b]' should look like state[0:3]"),
        (make(success="return"), UsageError, "success=return needs least=SUM of rewards, no other does"),
        (make(least=3), UsageError, "success=return needs least=SUM of rewards, no other does"),
        (make(success="luck"), UsageError, "success = 'luck': input should be 'info', 'terminated', 'survival' or"),
    ],
)
def test_what_cannot_be_is_one_line_that_names_it(
    called: Callable[[], object], kind_of: type[S2AError], message: str
) -> None:
    with pytest.raises(kind_of) as error:
        called()
    assert str(error.value).startswith(f"`robot`: gym: {message}")


def test_without_gymnasium_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(MissingExtra, match=r"the package gymnasium is not installed; pip install '.\[gym\]'"):
        robot()
