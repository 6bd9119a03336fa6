/* Made by tools/generate.py; do not edit. */
#ifndef DIARC_HASH_H
#define DIARC_HASH_H

/* First four bytes of the SHA-256 of can_protocol/diarc.dbc, line ends as LF. */
#define DIARC_DBC_HASH 0xD279D51Fu

#endif
