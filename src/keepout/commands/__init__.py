"""Each command of the command line as a function from its arguments to its JSON summary, a module for each group.

Each imports what it needs when it is called: who lists targets does not wait for what flies and draws.
"""
