# C11 without extensions and the flags of our own code, as the interface target diarc_flags.
set(CMAKE_C_STANDARD 11)
set(CMAKE_C_STANDARD_REQUIRED ON)
set(CMAKE_C_EXTENSIONS OFF)
set(CMAKE_EXPORT_COMPILE_COMMANDS ON)

add_library(diarc_flags INTERFACE)
target_compile_options(diarc_flags INTERFACE
    -O2 -g
    -ffp-contract=off # the same bits with and without a fused multiply-add
    -fno-math-errno   # a square root is one instruction
    -Wall -Wextra -Wconversion -Wshadow -Wdouble-promotion -Werror)

if(DIARC_FUZZ)
    if(NOT CMAKE_C_COMPILER_ID MATCHES "Clang")
        message(FATAL_ERROR "DIARC_FUZZ needs clang: cmake --preset fuzz")
    endif()
    set(DIARC_SANITIZE ON)
    target_compile_options(diarc_flags INTERFACE -fsanitize=fuzzer-no-link) # what an input reaches
endif()

if(DIARC_SANITIZE)
    set(sanitizers -fsanitize=address,undefined -fno-sanitize-recover=all -fno-omit-frame-pointer)
    target_compile_options(diarc_flags INTERFACE ${sanitizers})
    target_link_options(diarc_flags INTERFACE ${sanitizers})
endif()
