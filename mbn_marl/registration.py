"""The environments' ids in the registries of Gymnasium and PettingZoo."""

# They are ``mbn/field_03-v0`` and the like, and ``mbn/field_03-gusty-v0`` under a condition.
# Gymnasium has ``mbn/field_03-flat-v0`` too, with actions ``(2n,)``.
#
# Entry points are strings, so that an environment is imported only when one is made. Without an
# import of this package, use ``gymnasium.make("mbn_marl:mbn/field_03-v0")``.

from __future__ import annotations

from itertools import product
from typing import get_args

import gymnasium
import pettingzoo

from mbn_marl.config import Condition
from mbn_marl.field import catalogue_names


def environment_id(field_name: str, condition: Condition = "calm") -> str:
    """Return the id of the catalogue field ``field_name`` under a ``condition``."""
    return f"mbn/{field_name}-v0" if condition == "calm" else f"mbn/{field_name}-{condition}-v0"


def register_environments() -> None:
    """Register all fields and conditions: Gymnasium's are centralised, PettingZoo's are not."""
    # PettingZoo has a registry from 1.27 on.
    forms = {"parallel": "parallel_env", "aec": "env"} if hasattr(pettingzoo, "register") else {}
    for name in catalogue_names():
        gymnasium.register(
            f"mbn/{name}-flat-v0",
            entry_point="mbn_marl.adapters.gymnasium:CentralizedEnv",
            kwargs={"field": name, "flat": True},
        )
    for name, condition in product(catalogue_names(), get_args(Condition)):
        settings = {"field": name} | ({} if condition == "calm" else {"condition": condition})
        gymnasium.register(
            environment_id(name, condition),
            entry_point="mbn_marl.adapters.gymnasium:CentralizedEnv",
            vector_entry_point="mbn_marl.adapters.gymnasium:CentralizedVectorEnv",
            kwargs=settings,
        )
        for form, function in forms.items():
            entry = f"mbn_marl.navigation_v0:{function}"
            pettingzoo.register(
                form, environment_id(name, condition), entry_point=entry, kwargs=settings
            )
