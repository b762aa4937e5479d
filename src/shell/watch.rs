//! Descriptors of the kernel under the eyes of the runtime.

use std::os::fd::{AsFd, AsRawFd, RawFd};

use tokio::io::Interest;
use tokio::io::unix::AsyncFd;

/// Something that owns a descriptor.
#[derive(Debug)]
pub struct Descriptor<T>(pub T);

impl<T: AsFd> AsRawFd for Descriptor<T> {
    fn as_raw_fd(&self) -> RawFd {
        self.0.as_fd().as_raw_fd()
    }
}

/// Lets the runtime watch it. Needs a tokio runtime.
#[expect(
    deprecated,
    reason = "who owns its descriptor meets what the successor, marked unsafe, asks for"
)]
pub fn watched<T: AsFd>(owner: T, interest: Interest) -> std::io::Result<AsyncFd<Descriptor<T>>> {
    AsyncFd::with_interest(Descriptor(owner), interest)
}
