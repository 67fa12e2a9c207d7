"""`python -m openant_tools.cli`: the same as `openant`."""

from openant_tools.cli import main

main()
