"""The source paper's system made safe: a mesh, its certified field, law, guard, one flight and its audit.

A mesh enters in `geometry`, is learned and proved (`fields`, `learning`, `proof`, `measures`), steered around
(`motion`, `control`, `guard`), flown (`flight`, put together from a scenario by `mission`) and judged without any of it
(`audit`). Imports nothing of `flights`, `apps` or `cli`: what those
add to a scenario or a flight, they hand over.
"""
