"""Applications: whole tasks that are flown leg by leg, each a plug-in that nothing below names.

`inspection` sees all of a target, `unknown` explores one that nobody has a model of, `reproduction` is the source
paper's experiments, `gym` episodes that an agent steers. Each brings its scenario tables, its command, its layer of the
replay and its parts of a page, where it has some. Imports `core` and `flights`.
"""
