"""``longarm schema``."""

from __future__ import annotations

import click

from longarm_comp.cli.output import print_json


@click.command()
def command() -> None:
    """Print the JSON schema of arm.yaml.

    Editors complete and check an arm.yaml whose first line is
    `# yaml-language-server: $schema=arm.schema.json`.

    \b
    Example:
      longarm schema > arm.schema.json
    """
    from longarm_comp.core.arm.arm import Arm

    print_json(
        {"$schema": "https://json-schema.org/draft/2020-12/schema", **Arm.model_json_schema()}
    )
