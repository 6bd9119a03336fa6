# The ECU as an FMU, build/diarc_ecu.fmu: `cmake -DDIARC_PYTHON=.venv/bin/python`, then the target fmu. Its variables
# are made from the DBC by Python, and the headers of FMI are those that FMPy brings; so it is no part of `all`.
set(DIARC_PYTHON "" CACHE FILEPATH "Python with the project's packages, for the target fmu")
if(NOT DIARC_PYTHON)
    return()
endif()

execute_process(
    COMMAND "${DIARC_PYTHON}" -c "import fmpy, pathlib; print(pathlib.Path(fmpy.__file__).parent / 'c-code', end='')"
    OUTPUT_VARIABLE DIARC_FMI_HEADERS RESULT_VARIABLE result)
if(NOT result EQUAL 0)
    message(WARNING "no target fmu: ${DIARC_PYTHON} has no FMPy, whose headers it needs; make setup")
    return()
endif()

set(fmu_folder "${PROJECT_BINARY_DIR}/fmu")
set(fmu_header "${fmu_folder}/ports/fmu/variables.h")
file(MAKE_DIRECTORY "${fmu_folder}/ports/fmu")
set(fmu_export "${PROJECT_SOURCE_DIR}/tools/export_fmu.py")
diarc_sources(fmu_sources firmware/ports/fmu/*.c)
file(GLOB_RECURSE fmu_inputs CONFIGURE_DEPENDS "${PROJECT_SOURCE_DIR}/sil_plant/*.py")
list(APPEND fmu_inputs "${fmu_export}" "${PROJECT_SOURCE_DIR}/can_protocol/diarc.dbc"
    "${PROJECT_SOURCE_DIR}/can_protocol/parameters.toml" "${PROJECT_SOURCE_DIR}/sil_plant/arms/reference.toml")

add_custom_command(
    OUTPUT "${fmu_header}"
    COMMAND "${DIARC_PYTHON}" "${fmu_export}" ecu-header -o "${fmu_header}"
    DEPENDS ${fmu_inputs}
    VERBATIM)
add_library(diarc_ecu_fmu MODULE EXCLUDE_FROM_ALL ${fmu_sources} "${fmu_header}")
set_target_properties(diarc_ecu_fmu PROPERTIES
    PREFIX "" OUTPUT_NAME diarc_ecu LIBRARY_OUTPUT_DIRECTORY "${fmu_folder}" C_VISIBILITY_PRESET hidden)
target_include_directories(diarc_ecu_fmu PRIVATE "${fmu_folder}")
target_include_directories(diarc_ecu_fmu SYSTEM PRIVATE "${DIARC_FMI_HEADERS}")
target_link_libraries(diarc_ecu_fmu PRIVATE diarc_flags diarc_core_double)
# Several FMUs of this kind may be loaded into one process: each binds to its own functions and shows FMI's only.
target_link_options(diarc_ecu_fmu PRIVATE -Wl,-Bsymbolic -Wl,--exclude-libs,ALL)
if(NOT DIARC_SANITIZE)
    target_link_options(diarc_ecu_fmu PRIVATE -Wl,-z,defs)
endif()

add_custom_command(
    OUTPUT "${PROJECT_BINARY_DIR}/diarc_ecu.fmu"
    COMMAND "${DIARC_PYTHON}" "${fmu_export}" ecu --library "$<TARGET_FILE:diarc_ecu_fmu>"
            -o "${PROJECT_BINARY_DIR}/diarc_ecu.fmu"
    DEPENDS diarc_ecu_fmu "${fmu_header}"
    VERBATIM)
add_custom_target(fmu DEPENDS "${PROJECT_BINARY_DIR}/diarc_ecu.fmu")
