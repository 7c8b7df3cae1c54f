/* A mission's numbers, and the layout of the image of its tables. */
#ifndef MISSION_TABLES_H
#define MISSION_TABLES_H

#include "keepout.h"

extern const keepout_tables keepout_mission_layout; /* for keepout_open */
extern const uint32_t keepout_mission_digest;       /* likewise: the image's CRC-32 */

/* Put the mission together, from tables that keepout_open has filled; both must stay where they are. */
void keepout_mission_with(const keepout_tables *tables, keepout_mission *mission);

#endif
