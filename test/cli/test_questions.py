"""Questions on a terminal on which a progress bar runs."""

from asked_terminal import at_terminal

PROGRAM = """
import click
from longarm_comp.cli.output import progress
from longarm_comp.cli.signals import user_agrees

@click.command()
def main():
    with progress("loop") as show:
        show("half", 0.5)
        agreed = user_agrees("Apply this to the model in use?", False)
        show("more", 0.7)
    click.echo(f"agreed: {agreed}")

main()
"""


def test_a_question_is_read_beside_a_progress_bar_and_answered() -> None:
    """On a line of its own; the bar would go on over it, and over the answer."""
    ended, _, shown = at_terminal(["-c", PROGRAM], b"model in use? [y/N]: ", b"y")
    assert ended == 0 and b"agreed: True" in shown, shown
