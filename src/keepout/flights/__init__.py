"""More about flights: sensors and thrusters, campaigns, rare events, files of other programs, pages and replays.

Each package takes flights as `core` flies them: `navigation` says what is known of the motion, `campaign` flies many,
`rare_events` finds what happens seldom, `exchange` writes and audits files, `report` and `replay` show.
Imports `core` only, and names no application.
"""
