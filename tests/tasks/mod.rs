//! Terms, commands, events and sensors do what the task says.

mod a_description_may_be_wrong;
mod a_fall_costs_what_the_task_says;
mod a_reset_places_the_robot;
mod a_sensor_may_be_of_some_morphologies;
mod actions_become_targets;
mod commands_are_what_the_task_says;
mod curricula_change_commands_and_weights;
mod depth_cameras_see_the_ground;
mod envs_are_shared_out_among_robots;
mod observations_remember_their_own_episode;
mod randomisation_follows_its_ranges;
mod reward_terms_match_hand_computed_values;
mod reward_terms_of_each_robot;
mod robots_begin_in_any_pose;
mod terminations_have_a_bit_each;
mod terms_describe_themselves;
mod terms_of_any_body_match_their_formulas;
