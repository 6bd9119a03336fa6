/* Made by tools/generate.py; do not edit. */
#ifndef PARAMETER_LAYOUT_H
#define PARAMETER_LAYOUT_H

#define PARAMETER_COUNT 153
#define PARAMETER_IMAGE_BYTES 628
#define PARAMETER_LAYOUT_HASH 0x3D0421F1u
#define BASE_PRESSURE_LOW (20)
#define BASE_PRESSURE_HIGH (26)
#define BASE_AREA_LOW (-18)
#define BASE_AREA_HIGH (-6)
#define BASE_LEVER_LOW (-5)
#define BASE_LEVER_HIGH (1)
#define BASE_TORQUE_LOW (0)
#define BASE_TORQUE_HIGH (14)

#endif
