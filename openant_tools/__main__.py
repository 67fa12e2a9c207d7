"""`python -m openant_tools`: the same as `openant`."""

from openant_tools.cli import main

main()
