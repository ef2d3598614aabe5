"""Where simulation and recording differ: name the missing physics, put it into the model."""

from bo_sysid.diagnosis.answer import Answer
from bo_sysid.diagnosis.diagnose import Diagnosis, diagnose
from bo_sysid.diagnosis.explain import Unexplained
from bo_sysid.diagnosis.findings import Finding, Quantity

__all__ = ["Answer", "Diagnosis", "Finding", "Quantity", "Unexplained", "diagnose"]
