//! The repository keeps its own rules.

mod arrows_point_one_way;
mod crates_hold_code_and_robots_alone;
mod every_test_file_is_compiled;
mod examples_run;
mod kernels_branch_by_masks;
mod no_renderer_is_compiled;
mod no_robot_is_named_in_the_code;
mod shared_dependencies_are_built_once;
