"""Studies: YAML files from which everything runs."""

from bo_sysid.study.study import Study

__all__ = ["Study"]
