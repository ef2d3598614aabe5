"""`bo-sysid schema`: the JSON Schema of study files."""

import argparse
import json

from bo_sysid.cli.common import Verbs


def add_parser(verbs: "Verbs[argparse.ArgumentParser]") -> None:
    """Add the verb."""
    parser = verbs.add_parser(
        "schema",
        help="print the JSON Schema of study files",
        description="Print the JSON Schema of study files, so that editors complete and check "
        "them: bo-sysid schema > study.schema.json, and as first line of a study "
        "# yaml-language-server: $schema=study.schema.json",
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Print the schema, with the names that are registered."""
    from bo_sysid.cli.names import registered
    from bo_sysid.study import schema

    print(json.dumps(schema(**registered()), indent=2, ensure_ascii=False))
