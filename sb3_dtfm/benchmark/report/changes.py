"""Changes of `--label`s: the settings that differ from the profile's own, and the runs to compare."""

from collections.abc import Sequence
from typing import Any

from sb3_dtfm.benchmark.report.runs import Group, Run, Study

# Settings that tell runs apart, not labels.
NOT_A_CHANGE = ("dataset", "dataset_fraction", "dataset_seed", "fraction", "fraction_seed")


def split_changes(study: Study, studies: Sequence[Study]) -> tuple[list[Group], list[tuple[Group, list[Group]]]]:
    """
    Groups of a study that stand for themselves, and those to be compared with the same profile without a label.

    A label that was run for several algorithms, on other data perhaps, compares them anew; for one, it changes a setting.

    :param studies: all studies; where this one has no runs without a label, those of another one serve
    :return: groups that stand for themselves; and each group without a label that has labelled ones, with these
    """
    everywhere = [group for each in [*studies, study] for group in each.groups]
    plain = {group.profile: group for group in everywhere if not group.label}
    alone = [group for group in study.groups if not group.label or group.compares or group.profile not in plain]
    changed = [
        (base, labelled)
        for base in plain.values()
        if (labelled := [group for group in study.groups if group not in alone and group.profile == base.profile])
    ]
    return alone, changed


def changed_settings(run: Run, base: Sequence[Run]) -> str:
    """
    The settings of a run that differ from those of the runs without a label.

    :param base: runs of the same task and algorithm, of any seed and share of the data
    :return: `key: value` for each, with the value before; empty if nothing differs or nothing is there to compare
    """
    if not base:
        return ""
    before, now = (_flat(each.final["settings"]) for each in (base[0], run))
    parts = []
    for key in sorted(before.keys() | now.keys()):
        if key in NOT_A_CHANGE or before.get(key) == now.get(key):
            continue
        old = f" (not {before[key]})" if key in before else ""
        parts.append(f"`{key}: {now[key]}`{old}" if key in now else f"no `{key}`{old}")
    return ", ".join(parts)


def _flat(settings: dict[str, Any]) -> dict[str, Any]:
    """Put `policy_kwargs` and `dataset_kwargs` beside the other settings, and take the target return out of its wrapper."""
    apart = ("policy_kwargs", "dataset_kwargs", "env_wrapper")
    flat = {key: value for key, value in settings.items() if key not in apart}
    flat.update({**(settings.get("policy_kwargs") or {}), **(settings.get("dataset_kwargs") or {})})
    for wrapper in settings.get("env_wrapper") or []:
        for arguments in wrapper.values() if isinstance(wrapper, dict) else []:
            flat.update(arguments)
    return flat


def compared_runs(base: Group, changed: Group) -> list[tuple[str, float, str, list[Run], list[Run]]]:
    """
    The runs of a labelled group beside those without a label.

    :return: task, share of the data, algorithm, the labelled runs, and the others with the same seeds
    """
    return [
        (*key, runs, [run for run in base.of(*key) if run.key.seed in {each.key.seed for each in runs}])
        for key, runs in sorted(changed.runs.items(), key=lambda item: item[0])
    ]
