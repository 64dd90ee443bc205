//! Failure of a system of the pipeline: the sets after it are left out, and the caller gets its
//! error.

use std::cell::RefCell;
use std::panic::resume_unwind;

use bevy_ecs::error::{BevyError, ErrorContext, FallbackErrorHandler};
use bevy_ecs::prelude::*;
use bevy_ecs::schedule::ScheduleLabel;
use bevy_ecs::system::RegisteredSystemError;

use crate::error::Error;

thread_local! {
    /// The first error since [`run`] began. Systems run in their caller's thread, and error
    /// handlers have no access to the world.
    static FAULT: RefCell<Option<Error>> = const { RefCell::new(None) };
}

/// Bevy's handler for the errors of systems, commands and observers.
///
/// # Panics
/// A system has panicked, with its message.
fn note(mut error: BevyError, context: ErrorContext) {
    // Bevy catches panics of systems and hands them on as errors
    if let Some(payload) = error.take_payload() {
        resume_unwind(payload);
    }
    let error = own(&error, &context.name().to_string());
    FAULT.with_borrow_mut(|fault| {
        fault.get_or_insert(error);
    });
}

/// Run condition: no system has failed in this run of the schedule.
pub(super) fn none() -> bool {
    FAULT.with_borrow(Option::is_none)
}

/// Runs a schedule. The world's own handler of errors, which may be a host app's, is back
/// afterwards.
///
/// # Errors
/// The first error of its systems. The systems of later sets have not run then.
pub(crate) fn run(world: &mut World, schedule: impl ScheduleLabel) -> Result<(), Error> {
    let handler = world.get_resource::<FallbackErrorHandler>().copied();
    world.insert_resource(FallbackErrorHandler(note));
    FAULT.take();
    world.run_schedule(schedule);
    match handler {
        Some(handler) => world.insert_resource(handler),
        None => drop(world.remove_resource::<FallbackErrorHandler>()),
    }
    FAULT.take().map_or(Ok(()), Err)
}

/// The outcome of a system that was run alone.
///
/// # Errors
/// The system failed, or lacks its parameters.
pub(crate) fn outcome<I: SystemInput, T>(ran: std::result::Result<T, RegisteredSystemError<I, T>>) -> Result<T, Error> {
    ran.map_err(|error| match error {
        RegisteredSystemError::Failed(error) => own(&error, "of the pipeline"),
        error => Error::System { system: "of the pipeline".into(), problem: error.to_string() },
    })
}

/// The library's error that a system has returned; another one as [`Error::System`].
fn own(error: &BevyError, system: &str) -> Error {
    error.downcast_ref::<Error>().cloned().unwrap_or_else(|| {
        // Bevy adds a backtrace below
        let problem = error.to_string().lines().next().unwrap_or("it failed").to_string();
        Error::System { system: system.to_string(), problem }
    })
}
