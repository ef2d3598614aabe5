"""Studies: YAML files from which everything runs.

`Study` is light. The model, the recordings and the code that it names are loaded by
`bo_sysid.study.inputs`.
"""

from bo_sysid.study.schema import schema
from bo_sysid.study.source import parse_override
from bo_sysid.study.study import Study

__all__ = ["Study", "parse_override", "schema"]
