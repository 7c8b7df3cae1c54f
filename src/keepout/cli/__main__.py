"""`python -m keepout.cli`."""

from keepout.cli import main

main()
