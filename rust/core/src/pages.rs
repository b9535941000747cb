//! Large pages for large memory.

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
