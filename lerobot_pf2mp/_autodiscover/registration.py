# SPDX-License-Identifier: Apache-2.0
"""Registers this package with LeRobot and with Gymnasium, at the moment at which each of them is there.

The maths needs neither, and LeRobot alone takes several seconds to import. So ``import lerobot_pf2mp`` imports neither. It
registers at once with those that are imported already, and with the others as soon as somebody imports them:

    import lerobot_pf2mp              import lerobot.policies
    import lerobot.policies    or     import lerobot_pf2mp        both leave ``pf2mp`` in LeRobot's registries

LeRobot's own package file imports nothing, so that registration right after it meets no module of LeRobot that is half
imported. Nor may it meet one of ours: packages with modules that register (`policies`, `envs.configs`) import LeRobot
before any of these modules.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType


def register() -> None:
    """Registers policies, processor step, optimiser and environments, now or when LeRobot and Gymnasium are imported."""
    _once_imported("gymnasium", register_gym_environments)
    _once_imported("lerobot", register_with_lerobot)


def register_with_lerobot() -> None:
    """Registers policies, the processor step, the optimiser and configurations of environments with LeRobot."""
    # The decorators of these modules register.
    import lerobot_pf2mp.envs.configs.fetch
    import lerobot_pf2mp.envs.configs.handwriting
    import lerobot_pf2mp.envs.configs.maze
    import lerobot_pf2mp.policies.dppf.configuration_dppf
    import lerobot_pf2mp.policies.fmp.configuration_fmp
    import lerobot_pf2mp.policies.guided.potential_field_step
    import lerobot_pf2mp.policies.pf2mp.configuration_pf2mp  # noqa: F401


def register_gym_environments() -> None:
    """Registers the environments with Gymnasium; MuJoCo is imported when one is made."""
    import gymnasium

    from lerobot_pf2mp.envs import tasks

    for task, maze in tasks.MAZE_TASKS.items():
        gymnasium.register(
            id=f"lerobot_pf2mp/{task}",
            entry_point="lerobot_pf2mp.envs.maze.maze_env:MazeEnv",
            max_episode_steps=tasks.MAZE_STEPS,
            kwargs={"maze_map": maze},
        )
    for task, name in tasks.FETCH_TASKS.items():
        gymnasium.register(
            id=f"lerobot_pf2mp/{task}",
            entry_point="lerobot_pf2mp.envs.fetch.fetch_env:FetchEnv",
            max_episode_steps=tasks.FETCH_STEPS,
            kwargs={"task": name},
        )
    for task, space in tasks.HANDWRITING_TASKS.items():
        gymnasium.register(
            id=f"lerobot_pf2mp/{task}",
            entry_point="lerobot_pf2mp.envs.handwriting.handwriting_env:HandwritingEnv",
            max_episode_steps=tasks.HANDWRITING_STEPS,
            kwargs={"space": space},
        )


def _once_imported(package: str, call: Callable[[], None]) -> None:
    """Calls a function now if a package is imported, else right after its first import."""
    if sys.modules.get(package) is not None:
        call()
    else:
        sys.meta_path.insert(0, _Watch(package, call))


class _Watch(MetaPathFinder):
    """Waits in ``sys.meta_path`` for the import of one package, which the other finders find as ever."""

    def __init__(self, package: str, call: Callable[[], None]) -> None:
        self._package = package
        self._call = call

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name != self._package:
            return None
        for finder in sys.meta_path:
            spec = None if finder is self else finder.find_spec(name, path, target)
            if spec is not None and spec.loader is not None:
                spec.loader = _LoaderThenCall(spec.loader, self._then)
                return spec
        return None

    def _then(self) -> None:
        sys.meta_path.remove(self)
        self._call()


class _LoaderThenCall(Loader):
    """Loads a module as its own loader does, which it gets back, and then calls a function."""

    def __init__(self, loader: Loader, call: Callable[[], None]) -> None:
        self._loader = loader
        self._call = call

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        assert module.__spec__ is not None  # the import system has set it
        module.__spec__.loader = module.__loader__ = self._loader
        self._loader.exec_module(module)
        self._call()
