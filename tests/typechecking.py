"""The type checker that the tests install in every module: ints are floats, as everywhere else."""

from beartype import BeartypeConf, beartype

check = beartype(conf=BeartypeConf(is_pep484_tower=True))
