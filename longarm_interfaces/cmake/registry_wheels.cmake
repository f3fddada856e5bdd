# Lets this package build against ROS 2 from registry wheels; include it before any find_package.
# With a sourced ROS the environment is already right and every path exists, so it changes nothing.

# 1. No sourced ROS: it lies in the Python environment that holds ament_package, which is the active
#    one or the one that `make setup` builds in the folder above.
find_path(LONGARM_SOURCED_ROS share/ament_cmake/package.xml
  PATHS ENV AMENT_PREFIX_PATH ENV CMAKE_PREFIX_PATH NO_DEFAULT_PATH)
mark_as_advanced(LONGARM_SOURCED_ROS)

if(NOT LONGARM_SOURCED_ROS)
  get_filename_component(own_python "${CMAKE_CURRENT_LIST_DIR}/../../.venv/bin/python" ABSOLUTE)
  if("$ENV{VIRTUAL_ENV}" STREQUAL "" AND NOT DEFINED Python3_EXECUTABLE AND EXISTS "${own_python}")
    set(Python3_EXECUTABLE "${own_python}" CACHE FILEPATH "The Python that holds ROS")
  endif()
  find_package(Python3 REQUIRED COMPONENTS Interpreter)
  execute_process(
    COMMAND "${Python3_EXECUTABLE}" -c "import ament_package, pathlib, sys
package = pathlib.Path(ament_package.__file__).resolve()
holds_ros = lambda folder: (folder / 'share' / 'ament_cmake').is_dir()
print(next(filter(holds_ros, package.parents), sys.prefix))"
    OUTPUT_VARIABLE wheel_prefix
    OUTPUT_STRIP_TRAILING_WHITESPACE
    RESULT_VARIABLE no_ament_package
    ERROR_QUIET
  )
  if(NOT no_ament_package)
    set(prefixes $ENV{AMENT_PREFIX_PATH} "${wheel_prefix}")
    list(JOIN prefixes ":" prefixes)
    set(ENV{AMENT_PREFIX_PATH} "${prefixes}")
    list(APPEND CMAKE_PREFIX_PATH "${wheel_prefix}")
  endif()
endif()

# 2. The wheels name include folders of the machine that they were built on, and CMake refuses
#    imported targets whose include folders do not exist. Those are dropped once all are known.
function(longarm_drop_missing_include_folders)
  get_directory_property(targets IMPORTED_TARGETS)
  foreach(target IN LISTS targets)
    if(NOT target MATCHES "__rosidl_generator_py$")
      continue()
    endif()
    get_target_property(folders ${target} INTERFACE_INCLUDE_DIRECTORIES)
    if(NOT folders)
      continue()
    endif()
    set(kept "")
    foreach(folder IN LISTS folders)
      if(folder MATCHES "^\\$<" OR EXISTS "${folder}")
        list(APPEND kept "${folder}")
      endif()
    endforeach()
    set_target_properties(${target} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${kept}")
  endforeach()
endfunction()
cmake_language(DEFER CALL longarm_drop_missing_include_folders)
