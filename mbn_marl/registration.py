"""The environments' ids in the registries of Gymnasium and PettingZoo: ``mbn/field_03-v0`` ...

Entry points are strings, so that an environment is imported only when one is made. Without an
import of this package, use ``gymnasium.make("mbn_marl:mbn/field_03-v0")``.
"""

from __future__ import annotations

import gymnasium
import pettingzoo

from mbn_marl.field import catalogue_names


def environment_id(field_name: str) -> str:
    """Return the id of the catalogue field ``field_name``, such as ``mbn/field_03-v0``."""
    return f"mbn/{field_name}-v0"


def register_environments() -> None:
    """Register every catalogue field, centralised in Gymnasium, decentralised in PettingZoo.

    PettingZoo has a registry from 1.27 on.
    """
    forms = {"parallel": "parallel_env", "aec": "env"} if hasattr(pettingzoo, "register") else {}
    for name in catalogue_names():
        gymnasium.register(
            environment_id(name),
            entry_point="mbn_marl.adapters.gymnasium:CentralizedEnv",
            vector_entry_point="mbn_marl.adapters.gymnasium:CentralizedVectorEnv",
            kwargs={"field": name},
        )
        for form, function in forms.items():
            entry = f"mbn_marl.navigation_v0:{function}"
            pettingzoo.register(
                form, environment_id(name), entry_point=entry, kwargs={"field": name}
            )
