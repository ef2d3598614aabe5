"""Where simulation and recording differ: name the missing physics, put it into the model."""

from bo_sysid.diagnosis.answer.answer import Answer
from bo_sysid.diagnosis.answer.findings import Finding
from bo_sysid.diagnosis.answer.unexplained import Unexplained
from bo_sysid.diagnosis.diagnose import Diagnosis, diagnose
from bo_sysid.intervals import Quantity

__all__ = ["Answer", "Diagnosis", "Finding", "Quantity", "Unexplained", "diagnose"]
