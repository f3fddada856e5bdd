"""Where things lie in the checkout."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT / "test" / "data"
EXAMPLES = ROOT / "examples"
DEMO_ARM = ROOT / "config" / "arm_demo.yaml"
