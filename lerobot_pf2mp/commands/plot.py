# SPDX-License-Identifier: Apache-2.0
"""The command pf2mp-plot."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot.envs.configs import EnvConfig

from lerobot_pf2mp.commands.command import given
from lerobot_pf2mp.envs.configs.maze import PF2MPMazeEnv


@dataclass
class PlotConfig:
    """Draws a figure from benchmark results or from a checkpoint.

    lambda: collision and success rate against lambda, from --results. density, arrows: the potential field of
    --checkpoint. trajectories: episodes without and with guidance, from the same start and noise. overview: all of these
    for a maze. strokes: all strokes of --n_episodes episodes, without and with guidance. flow: an animation (GIF) of
    chunks that move from noise to trajectories. video: one episode without and with guidance, side by side (MP4). support:
    how each demonstrated episode of --checkpoint lies in the safe set of the others.

    Examples:
        pf2mp-plot --figure=lambda --results=[results/maze_lambda] --task=MazeLarge-v0 --output=lambda.png
        pf2mp-plot --figure=density --checkpoint=outputs/maze_large/checkpoints/last/pretrained_model \
--env.type=pf2mp_maze --env.task=MazeLarge-v0 --background=dark --output=density.png
        pf2mp-plot --figure=strokes --checkpoint=outputs/letter/checkpoints/last/pretrained_model --n_episodes=100 \
--env.type=pf2mp_handwriting --env.letter=S --output=strokes.png
        pf2mp-plot --figure=flow --checkpoint=you/your_pf2mp --options='{num_inference_steps: 20}' --output=flow.gif
    """

    # lambda, density, arrows, trajectories, overview, strokes, flow or video; or support.
    figure: str = "overview"
    # The file to write: PNG, GIF for flow, MP4 for video.
    output: Path | None = None
    # For lambda: folders written by pf2mp-benchmark, or their summary.csv.
    results: list[Path] = field(default_factory=list)
    # For lambda: the task, if the results are of several tasks.
    task: str | None = None
    # For the others: the pretrained_model folder of a pf2mp or dppf policy, or its repository on the Hub.
    checkpoint: str | None = None
    # The environment.
    env: EnvConfig = field(default_factory=PF2MPMazeEnv)
    # Changes to the policy's options, for example {guidance_scale: 0.4}.
    options: dict[str, Any] = field(default_factory=dict)
    # Numbers of the episodes to draw; by default those that show the difference best.
    episodes: list[int] = field(default_factory=list)
    # Number of episodes to draw if --episodes is empty; for flow, number of chunks.
    n_episodes: int = 6
    # Classes of processor steps of a checkpoint that may be imported although they are not registered, by full names.
    trust: list[str] = field(default_factory=list)
    # Seed of the first episode; episode i has this seed + i.
    seed: int = 100000
    # light or dark.
    background: str = "light"


def main(config: PlotConfig) -> None:
    """Runs the command."""
    from lerobot_pf2mp import figures
    from lerobot_pf2mp.figures.policy_figures import (
        FIGURES,
        GuidedPolicyFigures,
        make_lambda_figure,
        make_support_figure,
    )

    for option, value, choices in (
        ("--figure", config.figure, FIGURES),
        ("--background", config.background, tuple(figures.THEMES)),
    ):
        if value not in choices:
            raise ValueError(f"{option} must be one of {choices}, got {value!r}")
    if config.n_episodes < 1 or any(episode < 0 for episode in config.episodes):
        raise ValueError(
            f"--n_episodes must be at least 1 and --episodes at least 0, got {config.n_episodes} and {config.episodes}"
        )
    output = given("--output", config.output).expanduser()
    wanted = {"flow": ".gif", "video": ".mp4"}.get(config.figure, ".png")
    if output.suffix != wanted:
        raise ValueError(f"--output must end in {wanted} for this figure, got {output}")
    if config.figure == "lambda":
        if not config.results:
            raise ValueError("--results must name folders written by pf2mp-benchmark, got none")
        results = [path.expanduser() for path in config.results]
        make_lambda_figure(results, output, task=config.task, background=config.background)
    elif config.figure == "support":
        checkpoint = given("--checkpoint", config.checkpoint)
        make_support_figure(checkpoint, output, options=config.options, background=config.background)
    else:
        checkpoint = given("--checkpoint", config.checkpoint)
        of_policy = GuidedPolicyFigures(checkpoint, config.env, seed=config.seed, options=config.options)
        of_policy.draw(config.figure, output, config.n_episodes, config.episodes, config.background)
    print(f"Wrote {output}.")
