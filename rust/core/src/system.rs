//! What the system gives of memory: how much, and in large pages.

use sysinfo::{Pid, ProcessRefreshKind, ProcessesToUpdate, System};

/// Bytes that the machine, or the control groups of this process, can still give; without bound
/// where the system does not tell.
pub(crate) fn available_memory() -> usize {
    let Ok(mut system) = System::new() else {
        return usize::MAX;
    };
    system.refresh_memory();
    let own = Pid::from_u32(std::process::id());
    let kind = ProcessRefreshKind::nothing().without_tasks();
    system.refresh_processes_specifics(ProcessesToUpdate::Some(&[own]), false, kind);
    let group = system.process(own).and_then(|own| own.cgroup_limits());
    // The kernel takes back what caches files before a limit is hit; "free" leaves that out.
    let group = group.map_or(u64::MAX, |limits| {
        limits
            .total_memory
            .saturating_sub(limits.rss)
            .max(limits.free_memory)
    });
    usize::try_from(system.available_memory().min(group)).unwrap_or(usize::MAX)
}

/// Asks the system to map the room for `count` values at `start` in large pages, where that is
/// worth it: fresh memory costs a page fault per page, and reading here and there a walk through
/// their table.
pub(crate) fn ask_for_large<T>(start: *mut T, count: usize) {
    #[cfg(target_os = "linux")]
    {
        const LARGE: usize = 1 << 22;
        const PAGE: usize = 1 << 12;
        let bytes = count * size_of::<T>();
        if bytes >= LARGE {
            let start = start.cast::<libc::c_void>();
            let skipped = start.align_offset(PAGE);
            // SAFETY: the advice changes nothing that is in memory, nor does it read it; where it is
            // not taken, nothing is lost.
            unsafe {
                let whole = (bytes - skipped) / PAGE * PAGE;
                libc::madvise(start.wrapping_add(skipped), whole, libc::MADV_HUGEPAGE);
            }
        }
    }
    #[cfg(not(target_os = "linux"))]
    let _ = (start, count);
}
