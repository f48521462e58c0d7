# SPDX-License-Identifier: Apache-2.0
"""The largest values of options. Beyond them a command would only run out of memory or time."""

# By the last part of an option's name, whatever the command.
LIMITS: dict[str, float] = {
    "batch_size": 100_000,
    "episode_seed": 2**31 - 1,
    "episode_length": 1_000_000,
    "fps": 100_000,
    "image_width": 8192,
    "n_demonstrations": 1_000_000,
    "n_episodes": 1_000_000,
    "n_inner_steps": 10_000,
    "n_processes": 256,
    "n_regions": 1000,
    "n_repeats": 10_000,
    "n_steps": 100_000,
    "port": 65_535,
    "render_size": 10_000,
    "save_freq": 10**12,
    "seed": 2**31 - 1,
    "steps": 10**12,
    "total_steps": 10**12,
}
