//! Engines, plugins and viewers work through the same doors.

mod an_engine_may_be_anothers;
mod avian_engine;
mod links_have_mirrors_in_avians_world;
mod plugins_can_be_replaced;
mod polypod_joins_an_app;
mod simulation_api;
mod tasks_run_on_avian;
mod the_device_has_the_bits_of_the_cpu;
mod the_device_makes_whole_control_steps;
mod viewers_see_what_happens;
