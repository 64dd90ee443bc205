//! The promises of the library: a file each, in one executable, so that the library is linked once.

mod common;
#[path = "common/passive.rs"]
mod passive;
#[path = "common/trees.rs"]
mod trees;

mod a_broken_state_ends_only_its_own_episode;
mod a_drafted_robot_stands_level;
mod a_fall_costs_what_the_task_says;
mod actions_become_targets;
mod arrows_point_one_way;
mod avian_engine;
mod batch_composition_does_not_change_bits;
mod candidates_inside_a_foot_are_left_out;
mod collision_meshes_become_hulls;
mod config_errors_name_file_key_and_remedy;
mod config_layers_and_names_resolve;
mod contact_fuzz;
mod crates_hold_code_and_robots_alone;
mod dry_friction_holds_what_is_at_rest;
mod dynamics_identities;
mod energy_drift_has_the_expected_order;
mod envs_are_shared_out_among_robots;
mod equal_numbers_are_kept_once;
mod examples_run;
mod external_wrenches_move_the_base;
mod files_are_written_whole_or_not_at_all;
mod heights_are_one_surface;
mod jammed_links_do_not_sink;
mod joint_limits_hold_under_full_effort;
mod links_have_mirrors_in_avians_world;
mod loader_never_panics;
mod mesh_obstacles_are_read_once;
mod momentum_is_conserved_in_free_flight;
mod no_renderer_is_compiled;
mod no_robot_is_named_in_the_code;
mod obstacles_are_one_terrain;
mod plugins_can_be_replaced;
mod randomisation_follows_its_ranges;
mod reward_terms_match_hand_computed_values;
mod reward_terms_of_each_robot;
mod robot_assets_match_the_facts;
mod robot_loader_traps;
mod robot_roles_from_geometry;
mod robots_stand_on_their_feet;
mod robots_that_run_away_stay_in_their_lane;
mod rough_terrain_is_one_terrain;
mod rows_cannot_be_confused;
mod seeds_decide_the_draws;
mod self_collision_keeps_links_apart;
mod shared_dependencies_are_built_once;
mod simulation_api;
mod snapshot_round_trip_is_exact;
mod tasks_run_on_avian;
mod thread_count_does_not_change_bits;
mod varied_bodies_are_what_their_numbers_say;
