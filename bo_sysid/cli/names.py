"""Names that studies use and that registries know."""


def registered() -> dict[str, list[str]]:
    """Return what is registered, by the argument of `Study.check_names`."""
    from bo_sysid.recording.datasets import DATASETS

    return {"datasets": sorted(DATASETS)}
