# SPDX-License-Identifier: Apache-2.0
"""The potential field (`field`) and how it is fitted to demonstrated actions (`fitting`)."""

from lerobot_pf2mp.potential_field.field import PotentialField, check_alpha, check_periods
from lerobot_pf2mp.potential_field.fitting import (
    LEFT_OUT,
    THRESHOLD_QUANTILE,
    JudgedFit,
    check_left_out,
    check_threshold_quantile,
    fit,
    fit_judged,
    just_below,
    just_below_quantile,
)

__all__ = [
    "LEFT_OUT",
    "THRESHOLD_QUANTILE",
    "JudgedFit",
    "PotentialField",
    "check_alpha",
    "check_left_out",
    "check_periods",
    "check_threshold_quantile",
    "fit",
    "fit_judged",
    "just_below",
    "just_below_quantile",
]
