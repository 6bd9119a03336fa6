/* Made by tools/generate.py; do not edit. */
#ifndef OBJECT_LAYOUT_H
#define OBJECT_LAYOUT_H

#define OBJECT_ROWS 52
#define OBJECT_TEXTS 3
#define OBJECT_PDOS 9
#define OBJECT_SIGNALS 65
#define FIRST_ESTIMATE 0x2020u
#define FIRST_ESTIMATE_SD 0x2040u
#define FIRST_PARAMETER 0x2100u
#define FIRST_FRAME 0x3000u
#define REVISION_NUMBER 0x00000100u
#define SOFTWARE_VERSION "0.1.0"

enum object_type {
    TYPE_BOOL = 0x01,
    TYPE_I8 = 0x02,
    TYPE_I16 = 0x03,
    TYPE_I32 = 0x04,
    TYPE_U8 = 0x05,
    TYPE_U16 = 0x06,
    TYPE_U32 = 0x07,
    TYPE_R32 = 0x08,
    TYPE_TEXT = 0x09,
    TYPE_DOMAIN = 0x0F,
    TYPE_I24 = 0x10,
    TYPE_U24 = 0x16,
};

enum object_call {
    CALL_ERROR_REGISTER,
    CALL_ERROR_COUNT,
    CALL_ERROR_ENTRY,
    CALL_STORE,
    CALL_RESTORE,
    CALL_IMAGE,
    CALL_LOAD,
    CALL_LOAD_SD,
    CALL_CONTROL_WORD,
    CALL_STATUS_WORD,
};

#endif
