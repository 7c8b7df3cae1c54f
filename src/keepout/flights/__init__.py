"""More about flights: sensors and thrusters, on board, campaigns, rare events, files of other programs, pages, replays.

Each package takes flights as `core` flies them: `navigation` says what is known of the motion, `campaign` flies many,
`rare_events` finds what happens seldom, `exchange` writes and audits files, `pages` show, `on_board` steers in real
time. Imports `core` only, and names no application.
"""
