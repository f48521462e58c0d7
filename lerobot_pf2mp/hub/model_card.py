# SPDX-License-Identifier: Apache-2.0
"""The model card of a policy: its README.md on the Hub, made from what is known about it."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import PurePosixPath
from typing import Any

import draccus
from huggingface_hub import ModelCard, ModelCardData

from lerobot_pf2mp.hub.card_facts import POLICY_NAMES, CardFacts, GuidanceFacts

INSTALL = "pip install lerobot_policy_pf2mp"
DEFAULT_LICENSE = "apache-2.0"

_TAGS = {"fmp": ["flow-matching"], "pf2mp": ["flow-matching"], "dppf": ["diffusion"], "guarded": []}
_GENERATES = {
    "fmp": "It turns noise into a chunk of actions by integrating a learned velocity field.",
    "pf2mp": "It turns noise into a chunk of actions by integrating a learned velocity field.",
    "dppf": "It is LeRobot's Diffusion Policy, whose denoising turns noise into a chunk of actions.",
    "guarded": "Its weights are those of the policy that it guards, which generates the chunks of actions.",
}
_GUIDED = (
    "While it does so, a potential field, fitted to the demonstrated actions alone, steers every action back to where the "
    "demonstrations went, and so away from obstacles that nobody has modelled. The field is part of this repository and "
    "comes with the preprocessor; `--policy.guidance_scale=0` turns it off."
)
_CHECKED = "Every plan is checked with it before it is executed"
_DRAWN_AGAIN = ", and drawn again if it leaves the demonstrated region"
_METHOD = (
    "The method is *Towards Safe Imitation Learning via Potential Field-Guided Flow Matching* (Ding et al., IROS 2025, "
    "[arXiv:2508.08707](https://arxiv.org/abs/2508.08707))."
)
_LIMITS = (
    "Obstacles must be where they were in the demonstrations, and demonstrations must cover the free space that is needed: "
    "what was never visited counts as unsafe.",
    "The check sees the straight way between actions, as they are planned. A robot that does not follow them exactly may "
    "touch what the demonstrations passed closely.",
    "It is guidance, not a guarantee: collisions become rare, not impossible. Do not rely on it where people could be hurt.",
)
_UNGUIDED_LIMITS = ("It imitates the demonstrations and knows nothing of obstacles or of limits of a robot.",)


def make_model_card(facts: CardFacts) -> ModelCard:
    """The card of a policy of this package."""
    kind, license = facts.policy.type, facts.policy.license or DEFAULT_LICENSE
    guidance = facts.policy.guidance
    is_guided = guidance is not None
    base = [facts.policy.base] if facts.policy.base else []
    tags = ["lerobot", "pf2mp", *_TAGS[kind], "robotics", kind, *base, *facts.policy.tags]
    metadata = ModelCardData(
        library_name="lerobot",
        pipeline_tag="robotics",
        license=license,
        tags=list(dict.fromkeys(tags)),
        datasets=[str(facts.dataset)] if _is_on_the_hub(facts.dataset) else None,
    )
    sections = [
        f"# {facts.repo_id}",
        f"A {' '.join([*base, POLICY_NAMES[kind]])} for [LeRobot](https://github.com/huggingface/lerobot). "
        + _GENERATES[kind]
        + ("" if guidance is None else f" {_introduce(guidance)}"),
        "## Use",
        _usage(facts),
        "## Details",
        _table(_details(facts)),
        *_results(facts),
        "## Limits",
        "\n".join(f"- {limit}" for limit in (_LIMITS if is_guided else _UNGUIDED_LIMITS)),
        "## Licence",
        license,
    ]
    return ModelCard(f"---\n{metadata.to_yaml()}\n---\n\n" + "\n\n".join(sections) + "\n")


def env_options(env: Mapping[str, Any] | None) -> list[str]:
    """The options of lerobot-eval for an environment: its type, its task, and all values that differ from the defaults.

    Args:
        env: LeRobot's configuration of the environment as a dictionary; None if unknown.
    """
    from lerobot.envs.configs import EnvConfig

    if env is None or env["type"] not in EnvConfig.get_known_choices():
        return []
    defaults = draccus.encode(EnvConfig.get_choice_class(env["type"])(), EnvConfig)
    options = [f"--env.type={env['type']}"]
    for name, value in env.items():
        is_changed = (
            name in defaults and value != defaults[name] and not name.startswith(("type", "features"))
        )
        if is_changed or name == "task":
            text = value if isinstance(value, str) else json.dumps(value)
            options.append(f"--env.{name}={shlex.quote(text)}")
    return options


def _is_on_the_hub(dataset: str | None) -> bool:
    """Whether a dataset's name can be a name on the Hub. By default, this package's commands use names local/... ."""
    return bool(dataset and dataset.count("/") == 1 and not dataset.startswith("local/"))


def _introduce(guidance: GuidanceFacts) -> str:
    sentences = [_GUIDED, _METHOD]
    if guidance.plans is not None:
        sentences.insert(1, f"{_CHECKED}{_DRAWN_AGAIN if guidance.max_plans > 1 else ''}.")
    return " ".join(sentences)


def _usage(facts: CardFacts) -> str:
    dataset = facts.dataset if _is_on_the_hub(facts.dataset) else "you/your_dataset"
    env = " ".join(facts.env_options or ("--env.type=ENVIRONMENT", "--env.task=TASK"))
    kind, base = facts.policy.type, facts.policy.base
    new = f"--policy.type={kind}" + (f" --policy.base.type={base}" if base else "")
    commands = f"""\
```bash
{INSTALL}

# evaluate it
lerobot-eval --policy.path={facts.repo_id} {env} \\
    --eval.n_episodes=50 --eval.batch_size=10

# train a new one like it, or continue the training of this one
lerobot-train {new} --dataset.repo_id={dataset} --policy.repo_id=you/your_{kind}
lerobot-train --policy.path={facts.repo_id} --dataset.repo_id={dataset} --policy.repo_id=you/your_{kind}
```

In Python:

```python
from lerobot_pf2mp import load_policy
policy, preprocess, postprocess = load_policy("{facts.repo_id}")
action = postprocess(policy.select_action(preprocess(observation)))
```"""
    notes = [
        "`load_policy(..., revision=...)` takes everything from one revision; `lerobot-eval` takes the processors from the "
        "main branch whatever the revision, so download an older one first (`hf download "
        f"{facts.repo_id} --revision REVISION --local-dir FOLDER`) and give it the folder."
    ]
    if any(option.startswith("--env.type=pf2mp_") for option in facts.env_options):
        notes.append(
            "In the output of `lerobot-eval`, `avg_sum_reward` is minus the collision rate and `pc_success` the success "
            "rate [%]."
        )
    return "\n\n".join([commands, *notes])


def _details(facts: CardFacts) -> list[tuple[str, str]]:
    policy = facts.policy
    rows = [("dataset", _describe_dataset(facts))]
    for name, features in (("inputs", policy.inputs), ("outputs", policy.outputs)):
        if features:
            rows.append((name, ", ".join(f"`{key}` {tuple(shape)}" for key, shape in features.items())))
    rows.append(("chunk", f"{policy.horizon} actions, of which {policy.n_action_steps} are executed"))
    if policy.base is not None:
        rows.append(("guarded policy", policy.base))
    if policy.num_inference_steps is not None:
        rows.append(("steps N", str(policy.num_inference_steps)))
    if policy.guidance is not None:
        rows += _describe_guidance(policy.guidance)
    words = {"steps": "steps: {}", "batch_size": "batch size: {}", "seed": "seed: {}"}
    known = {key: facts.training.get(key) for key in words}
    if any(value is not None for value in known.values()):
        described = [words[key].format(value) for key, value in known.items() if value is not None]
        rows.append(("training", ", ".join(described)))
    versions = [f"{name} {version(name)}" for name in ("lerobot", "lerobot_policy_pf2mp")]
    rows.append(("versions", ", ".join(versions)))
    return rows


def _describe_dataset(facts: CardFacts) -> str:
    if facts.dataset is None:
        return "unknown"
    name = f"`{facts.dataset}`, not published"
    if _is_on_the_hub(facts.dataset):
        name = f"[{facts.dataset}](https://huggingface.co/datasets/{facts.dataset})"
    if facts.dataset_size is None:
        return name
    n_episodes, n_frames = facts.dataset_size
    return f"{name}: {n_episodes} episodes, {n_frames} frames"


def _describe_guidance(guidance: GuidanceFacts) -> list[tuple[str, str]]:
    point = f", field evaluated at: {guidance.point}" if guidance.point else ""
    rows = [
        ("guidance strength lambda", f"{guidance.scale:g}"),
        ("guidance integrator", f"{guidance.integrator}{point}"),
        ("guidance region", _describe_region(guidance)),
        ("plans", _describe_plans(guidance)),
    ]
    if guidance.bandwidth is None:
        return rows
    rule = f", by the rule {guidance.bandwidth_rule}" if guidance.bandwidth_rule else ""
    return [
        *rows,
        ("bandwidth h", f"{guidance.bandwidth:.4g} [normalised action units]{rule}"),
        ("anchors M", f"{guidance.n_anchors} demonstrated actions"),
        ("action dimensions of the field", ", ".join(map(str, guidance.action_dims))),
        *_describe_displacements(guidance),
        ("distance term alpha", f"{guidance.alpha:g}"),
    ]


def _describe_displacements(guidance: GuidanceFacts) -> list[tuple[str, str]]:
    if guidance.displacement_scale is None:
        return []
    scale = f"{guidance.displacement_scale:g} units of state per unit of action"
    return [("the field is over", f"the running sum of displacements from the observed state, {scale}")]


def _describe_region(guidance: GuidanceFacts) -> str:
    below = f"the {100 * guidance.quantile:g} % quantile of demonstrated actions"
    return {
        "everywhere": "everywhere",
        "unsupported": f"where the density is below {below}",
        "fading": f"fully outside the safe set, fading to nothing at {below}",
    }[guidance.region]


def _describe_plans(guidance: GuidanceFacts) -> str:
    if guidance.plans is None:
        return "not checked"
    plans = guidance.plans
    more = f", and drawn again up to {guidance.max_plans - 1} times" if guidance.max_plans > 1 else ""
    return (
        f"flagged if the log density on their way is below {plans.log_threshold:.4g}, which happens to at most "
        f"{100 * plans.false_alarm_rate:.2g} % of plans as good as a demonstration ({plans.n_plans} demonstrated plans)"
        f"{more}; what stays flagged: {guidance.on_unsupported}"
    )


def _results(facts: CardFacts) -> list[str]:
    if facts.table is None and not facts.figures:
        return []
    sections = ["## Results"]
    if facts.table is not None:
        sections.append(facts.table.strip())
        sections.append(
            "Rates are means over all episodes with their standard deviation over repeats, the interval is Wilson's, p is "
            "McNemar's exact test against the same weights, starts, goals and noise without guidance. Made by "
            "`pf2mp-benchmark`; all numbers are in [results/summary.csv](results/summary.csv), settings in "
            "[results/run.json](results/run.json)."
        )
        if "| plans |" in facts.table:
            sections.append(
                "plans is the mean number of plans that were drawn for one that was executed. An episode is flagged if one "
                "of the executed plans still left the demonstrated region; these rates have their Wilson interval in "
                "brackets."
            )
    if facts.made_with:
        made_with = ", ".join(f"{name} {value}" for name, value in facts.made_with.items())
        sections.append(f"Measured with {made_with}.")
    return [*sections, *(_show(figure, facts.repo_id) for figure in facts.figures)]


def _show(figure: str, repo_id: str) -> str:
    """An image or a video as Markdown. The Hub needs a full address for videos."""
    path = PurePosixPath(figure)
    if path.suffix == ".mp4":
        return f'<video controls src="https://huggingface.co/{repo_id}/resolve/main/{figure}"></video>'
    return f"![{path.stem.replace('_', ' ')}]({figure})"


def _table(rows: Sequence[tuple[str, str]]) -> str:
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)])
