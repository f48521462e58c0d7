# SPDX-License-Identifier: Apache-2.0
"""Registers this package with LeRobot and with Gymnasium, as soon as each of them is imported.

The maths needs neither of them, and the import of LeRobot takes several seconds. So ``import lerobot_pf2mp`` imports
neither. If one of them is already imported, it registers there at once, else directly after the first import of it:

    import lerobot_pf2mp              import lerobot.policies
    import lerobot.policies    or     import lerobot_pf2mp        both leave ``pf2mp`` in LeRobot's registries

The registration imports modules of LeRobot and of this package, and none of them may be half imported at that time.
``lerobot/__init__.py`` imports only its version, so no other module of LeRobot can be. In this package, the packages with
modules that register (`policies`, `envs.configs`) import LeRobot before any of these modules.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType
from typing import Any

# Also the namespace of the environments in Gymnasium.
PACKAGE = "lerobot_pf2mp"


def register() -> None:
    """Registers policies, processor step, optimiser and environments: now, or when LeRobot and Gymnasium are imported."""
    _once_imported("gymnasium", register_gym_environments)
    _once_imported("lerobot", register_with_lerobot)


def register_with_lerobot() -> None:
    """Registers policies, the processor step, the optimiser and configurations of environments with LeRobot."""
    # Decorators in these modules do the registration.
    import lerobot_pf2mp.envs.configs.fetch
    import lerobot_pf2mp.envs.configs.handwriting
    import lerobot_pf2mp.envs.configs.maze
    import lerobot_pf2mp.envs.configs.metaworld
    import lerobot_pf2mp.envs.configs.so101
    import lerobot_pf2mp.policies.dppf.configuration_dppf
    import lerobot_pf2mp.policies.fmp.configuration_fmp
    import lerobot_pf2mp.policies.guarded.configuration_guarded
    import lerobot_pf2mp.policies.guided.potential_field_step
    import lerobot_pf2mp.policies.pf2mp.configuration_pf2mp  # noqa: F401


def register_gym_environments() -> None:
    """Registers the environments with Gymnasium, unless they are registered; MuJoCo is imported when one is made."""
    import gymnasium

    from lerobot_pf2mp.envs import tasks

    env_classes = {
        "maze.maze_env:MazeEnv": ("maze_map", tasks.MAZE_TASKS, tasks.MAZE_STEPS),
        "fetch.fetch_env:FetchEnv": ("task", tasks.FETCH_TASKS, tasks.FETCH_STEPS),
        "handwriting.handwriting_env:HandwritingEnv": (
            "space",
            tasks.HANDWRITING_TASKS,
            tasks.HANDWRITING_STEPS,
        ),
        "metaworld.metaworld_env:MetaWorldEnv": (
            "task",
            {name: name for name in tasks.METAWORLD_TASKS},
            tasks.METAWORLD_STEPS,
        ),
    }
    for env_class, (argument, names, max_episode_steps) in env_classes.items():
        for name, value in names.items():
            if f"{PACKAGE}/{name}" not in gymnasium.registry:
                gymnasium.register(
                    id=f"{PACKAGE}/{name}",
                    entry_point=f"{PACKAGE}.envs.observed_env:make_observed_env",
                    max_episode_steps=max_episode_steps,
                    kwargs={"env_class": env_class, argument: value},
                )
    for name, (so101_class, n_steps) in tasks.SO101_CLASSES.items():
        if f"{PACKAGE}/{name}" not in gymnasium.registry:
            gymnasium.register(
                id=f"{PACKAGE}/{name}",
                entry_point=f"{PACKAGE}.envs.so101.{so101_class}",
                max_episode_steps=n_steps,
            )


def _once_imported(package: str, call: Callable[[], None]) -> None:
    """Calls a function now if a package is imported, else directly after its first import."""
    if sys.modules.get(package) is not None:
        call()
    else:
        sys.meta_path.insert(0, _Watch(package, call))


class _Watch(MetaPathFinder):
    """A finder in ``sys.meta_path`` that waits for the import of one package. The other finders find the package."""

    def __init__(self, package: str, call: Callable[[], None]) -> None:
        self._package = package
        self._call = call
        self._is_searching = False

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """The package's own spec, with a loader that also calls the function; None for every other module."""
        # While it searches, it must not find itself again, also not through the finder of another registration.
        if name != self._package or self._is_searching:
            return None
        self._is_searching = True
        try:
            spec = find_spec(name)
        finally:
            self._is_searching = False
        if spec is not None and spec.loader is not None:
            spec.loader = _LoaderThenCall(spec.loader, self._then)
        return spec

    def _then(self) -> None:
        # Removed only if it succeeds, so that a second import of the package tries again.
        self._call()
        # A new list: another thread may be looking through the old one.
        sys.meta_path = [finder for finder in sys.meta_path if finder is not self]


class _LoaderThenCall(Loader):
    """Loads a module with the module's own loader and then calls a function. The module keeps only its own loader."""

    def __init__(self, loader: Loader, call: Callable[[], None]) -> None:
        self._loader = loader
        self._call = call

    def __getattr__(self, name: str) -> Any:
        return getattr(self._loader, name)

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        """The module that the own loader creates."""
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        """Executes the module with its own loader, and then calls the function."""
        assert module.__spec__ is not None  # the import system has set it
        module.__spec__.loader = module.__loader__ = self._loader
        self._loader.exec_module(module)
        self._call()
