# SPDX-License-Identifier: Apache-2.0
"""What guidance and check cost a policy that is guarded: ACT as LeRobot makes it, and SmolVLA.

    python tests/benchmarks/guarded_cost.py                   # act; with .venv-vla/bin/python smolvla too

ACT has its default network, a state of six joints and one camera of 480 x 640 pixels. SmolVLA has the structure and the
sizes of its published network, with two cameras; all weights are random. The field has 20 000 anchors, demonstrations that
move slowly. In turns, and with the same weights, the base and its guarded form plan a chunk on one thread. The ratio is of
the median times of a chunk; its interval is a bootstrap over the rounds. Every plan passes the check, as nearly all plans of
a trained policy do, because its threshold is far down.
"""

from __future__ import annotations

import importlib.util
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies.factory import get_policy_class
from lerobot.utils.constants import ACTION, OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS, OBS_STATE
from tqdm import tqdm

from lerobot_pf2mp import GuardedConfig
from lerobot_pf2mp.policies.batch_keys import POTENTIAL_FIELD
from lerobot_pf2mp.policies.guarded.modeling_guarded import GuardedPolicy
from lerobot_pf2mp.policies.guided.demonstrated_actions import DemonstratedActions
from lerobot_pf2mp.process.atomic_files import file_written_beside

N_JOINTS = 6
N_RESAMPLED = 10_000


@dataclass
class GuardedCostConfig:
    """Times chunks of guarded policies."""

    # Rounds; each times one chunk of the base and one of its guarded form.
    n_rounds: int = 30
    # Folder of the results.
    output_dir: Path = Path("results/ablations/guarded_cost")


def main(config: GuardedCostConfig) -> None:
    """Measures the policies and writes the table."""
    torch.set_num_threads(1)
    rows = [measure(name, make, config.n_rounds) for name, make in policies()]
    lines = [
        "| policy | weights [million] | actions | base [ms] | guarded [ms] | ratio | 95 % interval |",
        "|---|---|---|---|---|---|---|",
        *(
            f"| {row['policy']} | {row['weights'] / 1e6:.0f} | {row['n_actions']} | {row['base_ms']:.1f} | "
            f"{row['guarded_ms']:.1f} | {row['ratio']:.3f} | {row['low']:.3f} to {row['high']:.3f} |"
            for row in rows
        ),
    ]
    config.output_dir.mkdir(parents=True, exist_ok=True)
    table = "\n".join(lines) + "\n"
    for name, text in {"table.md": table, "guarded_cost.json": json.dumps(rows, indent=1) + "\n"}.items():
        with file_written_beside(config.output_dir / name) as file:
            file.write_text(text, encoding="utf-8")
    print(table)


def policies() -> Iterator[tuple[str, Callable[[], tuple[PreTrainedConfig, dict[str, Any]]]]]:
    """The policies by name, each with a function that makes its configuration and an observation."""
    yield "act", act
    if importlib.util.find_spec("transformers"):
        yield "smolvla", smolvla


def act() -> tuple[PreTrainedConfig, dict[str, Any]]:
    """LeRobot's ACT with its default network."""
    make = PreTrainedConfig.get_choice_class("act")
    config = make(device="cpu", pretrained_backbone_weights=None, **features({"camera": (3, 480, 640)}))
    return config, observation(config)


def smolvla() -> tuple[PreTrainedConfig, dict[str, Any]]:
    """SmolVLA with the sizes of its published network."""
    from tiny_vla import write_smolvlm

    folder = Path("outputs/smolvlm")
    if not folder.exists():
        # HuggingFaceTB/SmolVLM2-500M-Video-Instruct
        write_smolvlm(
            folder,
            text={
                "hidden_size": 960,
                "intermediate_size": 2560,
                "num_hidden_layers": 32,
                "num_attention_heads": 15,
                "num_key_value_heads": 5,
                "head_dim": 64,
                "vocab_size": 49280,
            },
            vision={
                "hidden_size": 768,
                "intermediate_size": 3072,
                "num_hidden_layers": 12,
                "num_attention_heads": 12,
                "image_size": 512,
                "patch_size": 16,
            },
            scale_factor=4,
        )
    make = PreTrainedConfig.get_choice_class("smolvla")
    images = {"up": (3, 512, 512), "side": (3, 512, 512)}
    config = make(device="cpu", vlm_model_name=str(folder), **features(images))
    return config, {
        **observation(config),
        OBS_LANGUAGE_TOKENS: torch.full((1, 8), 6),
        OBS_LANGUAGE_ATTENTION_MASK: torch.ones(1, 8, dtype=torch.bool),
    }


def features(cameras: dict[str, tuple[int, int, int]]) -> dict[str, Any]:
    """Input and output features of an arm with cameras."""
    images = {
        f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, shape)
        for name, shape in cameras.items()
    }
    return {
        "input_features": {OBS_STATE: PolicyFeature(FeatureType.STATE, (N_JOINTS,)), **images},
        "output_features": {ACTION: PolicyFeature(FeatureType.ACTION, (N_JOINTS,))},
    }


def observation(config: PreTrainedConfig) -> dict[str, Any]:
    """A random observation of one robot."""
    generator = torch.Generator().manual_seed(0)
    return {
        key: torch.rand(1, *feature.shape, generator=generator)
        for key, feature in (config.input_features or {}).items()
    }


def demonstrated(config: GuardedConfig) -> DemonstratedActions:
    """Slow demonstrations, 20 000 actions of 200 episodes."""
    n_actions = len(config.action_delta_indices)
    generator = torch.Generator().manual_seed(0)
    starts = torch.rand(200, 1, N_JOINTS, generator=generator) - 0.5
    steps = 0.02 * torch.randn(200, 100, N_JOINTS, generator=generator)
    actions = (starts + steps.cumsum(dim=1))[:, :n_actions]
    shown = DemonstratedActions(config.field_settings)
    shown.observe(
        actions,
        None,
        100 * torch.arange(200),
        torch.arange(200),
        settings=config.field_settings,
        n_executed=config.n_action_steps,
    )
    return shown


def measure(
    name: str, make: Callable[[], tuple[PreTrainedConfig, dict[str, Any]]], n_rounds: int
) -> dict[str, Any]:
    """The times of a policy's chunks."""
    torch.manual_seed(0)
    base_config, seen = make()
    policy: Any = GuardedPolicy(GuardedConfig(base=base_config, on_unsupported="ignore")).eval()
    base: Any = get_policy_class(base_config.type)(base_config).eval()
    base.load_state_dict(policy.base.state_dict())
    batch = {**seen, POTENTIAL_FIELD: demonstrated(policy.config)}
    policy.guidance.measures_plans = True
    with torch.inference_mode():
        chunk = policy.predict_action_chunk(dict(batch))  # fits the field
    policy.guidance._plan_check = _passing(policy.guidance._plan_check)
    times: dict[str, list[float]] = {"base": [], "guarded": []}
    for number in tqdm(range(n_rounds + 2), desc=name, unit="round"):
        for key, plan, given in (("base", base, seen), ("guarded", policy, batch)):
            torch.manual_seed(number)
            began = time.perf_counter()
            with torch.inference_mode():
                plan.reset()
                plan.select_action(dict(given))
            if number >= 2:
                times[key].append(time.perf_counter() - began)
    both = 1000 * np.array([times["base"], times["guarded"]])
    draws = np.random.default_rng(0).integers(n_rounds, size=(N_RESAMPLED, n_rounds))
    medians = np.median(both[:, draws], axis=2)
    low, high = np.quantile(medians[1] / medians[0], [0.025, 0.975])
    base_ms, guarded_ms = np.median(both, axis=1)
    return {
        "policy": name,
        "weights": sum(weight.numel() for weight in base.parameters()),
        "n_actions": chunk.shape[1],
        "base_ms": float(base_ms),
        "guarded_ms": float(guarded_ms),
        "ratio": float(guarded_ms / base_ms),
        "low": float(low),
        "high": float(high),
    }


def _passing(make: Callable[..., Any]) -> Callable[..., Any]:
    """The check with a threshold that every plan passes: its cost without that of other plans."""
    from dataclasses import replace

    return lambda *args: replace(make(*args), log_threshold=-1e30)


if __name__ == "__main__":
    main(draccus.parse(GuardedCostConfig))
