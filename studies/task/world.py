"""Meta-World's tasks, observed with all that a copy of the simulator needs to continue from there.

The observation is one vector:

| values | meaning |
|---|---|
| 39 | Meta-World's observation; the first 18 are the frame that the next observation repeats as the previous one |
| 3 or 6 | the task's random vector: a reset with it puts goal, object and furniture where they were |
| the rest | MuJoCo's integration state: positions, velocities, actuation, the mocap pose, the solver's warm start |
"""

from __future__ import annotations

from typing import Any, Final, SupportsFloat

import gymnasium
import metaworld
import mujoco
import numpy as np
from numpy.typing import NDArray

from s2a_bench.types import Vector

SEEN: Final = 39
"""Values of Meta-World's own observation."""
FRAME: Final = 18
PHYSICS: Final = mujoco.mjtState.mjSTATE_INTEGRATION


class World(gymnasium.Wrapper[Any, Any, Any, Any]):
    """The task ``env_name``, as push-v3; seed n begins with goal n modulo 50 of Meta-World's MT1."""

    def __init__(self, env_name: str) -> None:
        benchmark = metaworld.MT1(env_name, seed=0)
        super().__init__(benchmark.train_classes[env_name]())
        self._tasks = benchmark.train_tasks
        self.unwrapped.set_task(self._tasks[0])

    @property
    def unwrapped(self) -> Any:
        return super().unwrapped

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if seed is not None:
            self.unwrapped.set_task(self._tasks[seed % len(self._tasks)])
        seen, info = super().reset(options=options)
        return self._whole(seen), info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        seen, reward, terminated, truncated, info = super().step(action)
        return self._whole(seen), reward, terminated, truncated, info

    def _whole(self, seen: NDArray[np.float64]) -> NDArray[np.float64]:
        world = self.unwrapped
        physics = np.empty(mujoco.mj_stateSize(world.model, PHYSICS))
        mujoco.mj_getState(world.model, world.data, physics, PHYSICS)
        return np.concatenate((seen, world._last_rand_vec, physics))  # noqa: SLF001 - no other way to it


class Copy:
    """A copy of a task's simulator, which continues from an observation of `World`."""

    def __init__(self, env_name: str) -> None:
        self._world = World(env_name).unwrapped
        turned = np.zeros_like(self._world._get_quat_objects())  # noqa: SLF001
        self._world._get_quat_objects = lambda: turned  # noqa: SLF001 - slow to compute, and no expert reads it

    def restore(self, whole: Vector) -> NDArray[np.float64]:
        """Continue from an observation; return Meta-World's part of it."""
        world, numbers = self._world, whole.astype(np.float64)
        size = mujoco.mj_stateSize(world.model, PHYSICS)
        seen, placed, physics = np.split(numbers, (SEEN, numbers.size - size))
        if not np.array_equal(placed, world._last_rand_vec):  # noqa: SLF001
            world._last_rand_vec = placed  # noqa: SLF001
            world.reset()
        mujoco.mj_setState(world.model, world.data, physics, PHYSICS)
        world._prev_obs, world.curr_path_length = seen[:FRAME].copy(), 0  # noqa: SLF001
        return seen

    def step(self, action: Vector) -> NDArray[np.float64]:
        """Return Meta-World's observation after an action, without the orientation of objects."""
        world = self._world
        world.set_xyz_action(action[:3])
        world.do_simulation([action[3], -action[3]], world.frame_skip)
        mujoco.mj_forward(world.model, world.data)  # as a step does; the reward of one takes half of its time
        seen: NDArray[np.float64] = world._get_obs()  # noqa: SLF001
        return seen


gymnasium.register("s2a/MetaWorld-v0", entry_point=f"{__name__}:World")
