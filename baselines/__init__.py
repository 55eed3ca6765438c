"""Training, evaluation and comparison of centralised and decentralised baselines."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from baselines.policies.loaded import LoadedPolicy
    from mbn_marl.field import Field

__all__ = ["load_policy"]


def load_policy(
    source: str | Path, field: "str | Path | Field | None" = None, *, seed: int = 0, **settings: Any
) -> "LoadedPolicy":
    """Load a policy that is ready to act, with the settings of the environment that it wants.

    Args:
        source: ``"zoo:NAME"``, a policy of ``mbn zoo``, or ``"zoo"``, that of the field; the folder
            of a run (of an unfinished one, its newest checkpoint counts); ``"greedy"``,
            ``"planner"`` or ``"replan"``, which act on the state; ``"random"``; or
            ``"module:callable"``, your own: it is called with the field, or ``None``, and returns
            an object with ``act(observations, deterministic=True)`` and, if it likes,
            ``settings``, ``observes`` and ``reset(worlds)``, or a function of the observations.
        field: a catalogue name, a file or a :class:`~mbn_marl.Field`; ``None``: that of the run
            or of the zoo's policy. Greedy, planner and replan need one; the latter two plan in it,
            for up to 60 seconds.
        seed: of random actions, >= 0.
        **settings: settings of :class:`~mbn_marl.config.NavigationConfig` that replace those that
            the policy brings; the weather and the failures of a ``condition`` replace all of them.

    Raises:
        ConfigError: listing what is wrong: a field is missing, or the policy was trained for other
            robots, ROIs or observations, or your callable returns no policy.
        MbnError: the zoo has no such policy (the message lists those it has), or no plan was found;
            or (:class:`baselines.runs.files.RunError`) there is no run, or it has saved no policy,
            or an older version wrote it.
        FieldError: the field is unknown or not valid.
        ModuleNotFoundError: the extra ``baselines`` is not installed.
    """
    try:
        from baselines.policies.load import Source
    except ModuleNotFoundError as error:
        from mbn_marl.errors import install

        error.add_note(f"{install('baselines')} brings what policies need")
        raise
    policy = Source(str(source)).make(field, seed=seed, **settings)
    _ = policy.fitted  # raises
    return policy
