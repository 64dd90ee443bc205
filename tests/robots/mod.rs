//! Robots are read as their descriptions say, or refused.

mod a_drafted_robot_stands_level;
mod a_makers_sign_does_not_reach_the_policy;
mod an_empty_root_is_no_base;
mod collision_meshes_become_hulls;
mod every_robot_stands_or_says_why;
mod joint_descriptors_say_what_a_body_is;
mod left_and_right_are_compared;
mod limbs_are_found_by_geometry;
mod loader_never_panics;
mod other_bodies_match_the_facts;
mod robot_assets_match_the_facts;
mod robot_loader_traps;
mod robot_roles_from_geometry;
mod robots_stand_on_their_feet;
mod units_are_plausible;
mod varied_bodies_are_what_their_numbers_say;
