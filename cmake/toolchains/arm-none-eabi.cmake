# Debian's gcc for bare-metal Arm; a file for each processor includes this one and sets the processor's flags.
set(CMAKE_SYSTEM_NAME Generic)
set(CMAKE_SYSTEM_PROCESSOR arm)
set(CMAKE_TRY_COMPILE_TARGET_TYPE STATIC_LIBRARY) # there is no C library to link a program with

find_program(ARM_GCC arm-none-eabi-gcc)
if(NOT ARM_GCC)
    message(FATAL_ERROR "arm-none-eabi-gcc is not installed: sudo apt-get install gcc-arm-none-eabi")
endif()
set(CMAKE_C_COMPILER "${ARM_GCC}")
