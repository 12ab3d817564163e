//! Unpacking at the speed of memory: the same pixels as [`Packing::unpack`], four to sixteen at a time.
//!
//! All packings of 10 and 12 bits use the same computation. Two bytes, read as a 16-bit word, contain all bits of a
//! pixel: some need only a shift to the right, others must first be shifted to the left, which is a multiplication.
//! Packings differ only in the positions of the bytes, the factors and the masks.

use pulp::NullaryFnOnce;

use super::Packing;

/// The instruction set used to unpack pixels. All give the same pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UnpackLevel {
    /// The baseline instruction set, as the compiler uses it.
    Portable,
    /// x86-64 with SSE4.2: eight pixels at a time.
    Sse42,
    /// x86-64 with AVX2: sixteen pixels at a time.
    Avx2,
}

impl UnpackLevel {
    /// All levels that this machine supports, fastest last.
    pub fn available() -> &'static [Self] {
        match Self::best() {
            Self::Portable => &[Self::Portable],
            Self::Sse42 => &[Self::Portable, Self::Sse42],
            Self::Avx2 => &[Self::Portable, Self::Sse42, Self::Avx2],
        }
    }

    /// The fastest level that this machine supports.
    pub fn best() -> Self {
        #[cfg(target_arch = "x86_64")]
        if pulp::x86::V3::is_available() {
            return Self::Avx2;
        } else if pulp::x86::V2::is_available() {
            return Self::Sse42;
        }
        Self::Portable
    }
}

/// Pixels described by a [`Layout`]: the smallest number that fills whole bytes in every packing.
const GROUP: usize = 4;

/// The layout of four neighbouring pixels in `BYTES` bytes. With the word made of its two bytes, pixel `k` is
/// `word >> shift & high_mask | word * scale[k] >> shift & low_mask`.
struct Layout<const BYTES: usize> {
    /// Low and high byte of each pixel's word.
    word: [[u8; 2]; GROUP],
    scale: [u16; GROUP],
    high_mask: u16,
    low_mask: u16,
    /// The same for the portable kernel, computed at compile time.
    moves: [Move; MOVES],
}

const BITS10P: Layout<5> = Layout::new(6, [[0, 1], [1, 2], [2, 3], [3, 4]], [64, 16, 4, 1], [0, 0x3FF]);
const BITS10G40: Layout<5> = Layout::new(6, [[4, 0], [4, 1], [4, 2], [4, 3]], [64, 16, 4, 1], [0x3FC, 0x003]);
const BITS10PACKED: Layout<6> =
    Layout::new(6, [[1, 0], [1, 2], [4, 3], [4, 5]], [64, 4, 64, 4], [0x3FC, 0x003]);
const BITS12P: Layout<6> = Layout::new(4, [[0, 1], [1, 2], [3, 4], [4, 5]], [16, 1, 16, 1], [0, 0xFFF]);
const BITS12PACKED: Layout<6> =
    Layout::new(4, [[1, 0], [1, 2], [4, 3], [4, 5]], [16, 1, 16, 1], [0xFF0, 0x00F]);
const BITS12G24: Layout<6> = Layout::new(4, [[2, 0], [2, 1], [5, 3], [5, 4]], [16, 1, 16, 1], [0xFF0, 0x00F]);

impl<const BYTES: usize> Layout<BYTES> {
    const fn new(shift: u32, word: [[u8; 2]; GROUP], scale: [u16; GROUP], masks: [u16; 2]) -> Self {
        let [high_mask, low_mask] = masks;
        let moves = [Move { by: 0, mask: 0 }; MOVES];
        let layout = Self { word, scale, high_mask, low_mask, moves };
        Self { moves: layout.moved(shift), ..layout }
    }
}

/// Unpacks `bytes`, which must hold exactly as many pixels as `pixels`.
pub(super) fn unpack(level: UnpackLevel, packing: Packing, bytes: &[u8], pixels: &mut [u16]) {
    run(level, Unpack { packing, bytes, pixels });
}

/// Adds the pixels of `bytes`, which must hold exactly one pixel per sum.
pub(super) fn add(level: UnpackLevel, packing: Packing, bytes: &[u8], sums: &mut [u32]) {
    run(level, Add { packing, bytes, sums, on_block: |_: usize, _: &[u16]| {} });
}

/// [`add`] that also counts, in the second part of `reached`, the pixels of at least its first part. Returns whether
/// there are any.
pub(super) fn add_counting(
    level: UnpackLevel,
    packing: Packing,
    bytes: &[u8],
    sums: &mut [u32],
    reached: (u16, &mut [u32]),
) -> bool {
    let (limit_dn, counts) = reached;
    let mut any = false;
    // Most blocks have no such pixel, so that their counts need not be fetched.
    let on_block = |first: usize, pixels: &[u16]| {
        if pixels.iter().fold(0, |most, &pixel| pixel.max(most)) >= limit_dn {
            any = true;
            let counts = counts[first..].iter_mut().zip(pixels);
            counts.for_each(|(count, &pixel)| *count += u32::from(pixel >= limit_dn));
        }
    };
    run(level, Add { packing, bytes, sums, on_block });
    any
}

/// A computation that every level can run.
trait Task {
    fn run<K: Kernel>(self, kernel: K);
}

fn run(level: UnpackLevel, task: impl Task) {
    #[cfg(target_arch = "x86_64")]
    match level {
        UnpackLevel::Avx2 => {
            if let Some(simd) = pulp::x86::V3::try_new() {
                return simd.vectorize(On { kernel: simd, task });
            }
        }
        UnpackLevel::Sse42 => {
            if let Some(simd) = pulp::x86::V2::try_new() {
                return simd.vectorize(On { kernel: simd, task });
            }
        }
        UnpackLevel::Portable => {}
    }
    On { kernel: Portable, task }.call();
}

/// A task with a level's instructions.
struct On<K, T> {
    kernel: K,
    task: T,
}

impl<K: Kernel, T: Task> NullaryFnOnce for On<K, T> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        self.task.run(self.kernel);
    }
}

struct Unpack<'a> {
    packing: Packing,
    bytes: &'a [u8],
    pixels: &'a mut [u16],
}

impl Task for Unpack<'_> {
    #[inline(always)]
    fn run<K: Kernel>(self, kernel: K) {
        let Self { packing, bytes, pixels } = self;
        match packing {
            // The compiler's code for the reference implementation is as fast as memory.
            Packing::Bits8 | Packing::Bits10 | Packing::Bits12 | Packing::Bits16 => {
                packing.unpack(bytes, pixels);
            }
            Packing::Bits10p => by_groups::<6, _, _>(kernel, packing, &BITS10P, bytes, pixels),
            Packing::Bits10g40 => by_groups::<6, _, _>(kernel, packing, &BITS10G40, bytes, pixels),
            Packing::Bits10Packed => by_groups::<6, _, _>(kernel, packing, &BITS10PACKED, bytes, pixels),
            Packing::Bits12p => by_groups::<4, _, _>(kernel, packing, &BITS12P, bytes, pixels),
            Packing::Bits12Packed => by_groups::<4, _, _>(kernel, packing, &BITS12PACKED, bytes, pixels),
            Packing::Bits12g24 => by_groups::<4, _, _>(kernel, packing, &BITS12G24, bytes, pixels),
        }
    }
}

struct Add<'a, F> {
    packing: Packing,
    bytes: &'a [u8],
    sums: &'a mut [u32],
    /// Called for the pixels of each block, with the index of the first.
    on_block: F,
}

impl<F: FnMut(usize, &[u16])> Task for Add<'_, F> {
    #[inline(always)]
    fn run<K: Kernel>(self, kernel: K) {
        // A block of pixels fits in the L1 cache. It is a multiple of the group, so that each block begins at a whole
        // byte.
        const BLOCK: usize = 1024;
        let mut block = [0; BLOCK];
        let blocks = self.bytes.chunks(self.packing.bytes(BLOCK)).zip(self.sums.chunks_mut(BLOCK));
        let mut on_block = self.on_block;
        for (index, (bytes, sums)) in blocks.enumerate() {
            let pixels = &mut block[..sums.len()];
            Unpack { packing: self.packing, bytes, pixels }.run(kernel);
            on_block(index * BLOCK, pixels);
            sums.iter_mut().zip(pixels).for_each(|(sum, pixel)| *sum += u32::from(*pixel));
        }
    }
}

/// The implementation of one level, which unpacks whole groups.
trait Kernel: Copy {
    /// Unpacks any number of groups, starting at the first, and returns how many.
    fn groups<const SHIFT: u32, const BYTES: usize>(
        self,
        layout: &Layout<BYTES>,
        groups: &[[u8; BYTES]],
        pixels: &mut [[u16; GROUP]],
    ) -> usize;
}

#[derive(Clone, Copy)]
struct Portable;

impl Kernel for Portable {
    /// Handles whole groups as 64-bit numbers: bits that move by the same distance move at once, and vectors hold
    /// several groups.
    #[inline(always)]
    fn groups<const SHIFT: u32, const BYTES: usize>(
        self,
        layout: &Layout<BYTES>,
        groups: &[[u8; BYTES]],
        pixels: &mut [[u16; GROUP]],
    ) -> usize {
        let bytes = groups.as_flattened();
        let mut done = 0;
        for pixels in pixels.as_chunks_mut::<ABREAST>().0 {
            // The last load reads beyond its group.
            let Some(bytes) = bytes.get(done * BYTES..(done + ABREAST - 1) * BYTES + 8) else { break };
            let groups: [u64; ABREAST] = std::array::from_fn(|group| {
                let bytes = bytes[group * BYTES..].first_chunk();
                bytes.map_or(0, |bytes| u64::from_le_bytes(*bytes))
            });
            for (group, pixels) in groups.into_iter().zip(pixels) {
                let unpacked = layout.moves.iter().fold(0, |unpacked, step| unpacked | step.of(group));
                *pixels = std::array::from_fn(|k| (unpacked >> (16 * k)) as u16);
            }
            done += ABREAST;
        }
        done
    }
}

/// Groups that the portable kernel unpacks per step.
const ABREAST: usize = 4;
/// An upper limit: no packing needs more.
const MOVES: usize = 8;

/// Bits of a group that move to the left by the same distance, to their positions in four unpacked pixels.
#[derive(Clone, Copy)]
struct Move {
    by: i32,
    mask: u64,
}

impl Move {
    #[inline(always)]
    fn of(self, group: u64) -> u64 {
        let moved = if self.by < 0 { group >> -self.by } else { group << self.by };
        moved & self.mask
    }
}

impl<const BYTES: usize> Layout<BYTES> {
    /// The moves by which the portable kernel unpacks a group.
    const fn moved(&self, shift: u32) -> [Move; MOVES] {
        let mut moves = [Move { by: 0, mask: 0 }; MOVES];
        let mut to = 0;
        while to < 16 * GROUP {
            let (pixel, bit) = (to / 16, to as u32 % 16);
            let from = if self.high_mask >> bit & 1 == 1 {
                Some(bit + shift)
            } else if self.low_mask >> bit & 1 == 1 {
                Some(bit + shift - self.scale[pixel].trailing_zeros())
            } else {
                None
            };
            if let Some(from) = from {
                let byte = self.word[pixel][from as usize / 8] as i32;
                let by = to as i32 - 8 * byte - from as i32 % 8;
                let mut place = 0;
                while moves[place].mask != 0 && moves[place].by != by {
                    place += 1;
                }
                moves[place] = Move { by, mask: moves[place].mask | 1 << to };
            }
            to += 1;
        }
        moves
    }
}

/// Unpacks with the kernel, and the few remaining pixels with the reference implementation.
#[inline(always)]
fn by_groups<const SHIFT: u32, const BYTES: usize, K: Kernel>(
    kernel: K,
    packing: Packing,
    layout: &Layout<BYTES>,
    bytes: &[u8],
    pixels: &mut [u16],
) {
    let (pixel_groups, _) = pixels.as_chunks_mut::<GROUP>();
    let (groups, _) = bytes.as_chunks::<BYTES>();
    let groups = &groups[..pixel_groups.len()];
    let done = kernel.groups::<SHIFT, BYTES>(layout, groups, pixel_groups);
    packing.unpack(&bytes[done * BYTES..], &mut pixels[done * GROUP..]);
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::__m128i;

    use pulp::bytemuck::cast;
    use pulp::x86::{V2, V3};

    use super::{GROUP, Kernel, Layout};

    /// Groups in a vector of eight pixels, and in each half of a vector of sixteen; bytes cannot be shuffled between
    /// halves.
    const HALF: usize = 2;
    const WHOLE: usize = 2 * HALF;

    /// For each byte of a vector of words, the byte of its half that it comes from.
    fn shuffle<const VECTOR_BYTES: usize, const BYTES: usize>(layout: &Layout<BYTES>) -> [u8; VECTOR_BYTES] {
        std::array::from_fn(|i| {
            let group = i % 16 / (2 * GROUP);
            (group * BYTES) as u8 + layout.word[i / 2 % GROUP][i % 2]
        })
    }

    fn scale<const PIXELS: usize, const BYTES: usize>(layout: &Layout<BYTES>) -> [u16; PIXELS] {
        std::array::from_fn(|i| layout.scale[i % GROUP])
    }

    /// Sixteen bytes, of which a half needs the first ones; `None` if they would reach beyond the end.
    #[inline(always)]
    fn half(bytes: &[u8], at: usize) -> Option<__m128i> {
        Some(cast::<[u8; 16], __m128i>(*bytes.get(at..)?.first_chunk()?))
    }

    impl Kernel for V2 {
        #[inline(always)]
        fn groups<const SHIFT: u32, const BYTES: usize>(
            self,
            layout: &Layout<BYTES>,
            groups: &[[u8; BYTES]],
            pixels: &mut [[u16; GROUP]],
        ) -> usize {
            let (sse2, ssse3) = (self.sse2, self.ssse3);
            let (shuffle, scale) = (cast(shuffle::<16, BYTES>(layout)), cast(scale::<8, BYTES>(layout)));
            let (high_mask, low_mask) = (cast([layout.high_mask; 8]), cast([layout.low_mask; 8]));
            let shifted = |word| match SHIFT {
                4 => sse2._mm_srli_epi16::<4>(word),
                _ => sse2._mm_srli_epi16::<6>(word),
            };

            let bytes = groups.as_flattened();
            let mut done = 0;
            for pixels in pixels.as_chunks_mut::<HALF>().0 {
                let Some(bytes) = half(bytes, done * BYTES) else { break };
                let word = ssse3._mm_shuffle_epi8(bytes, shuffle);
                let high = sse2._mm_and_si128(shifted(word), high_mask);
                let low = sse2._mm_and_si128(shifted(sse2._mm_mullo_epi16(word, scale)), low_mask);
                *pixels = cast(sse2._mm_or_si128(high, low));
                done += HALF;
            }
            done
        }
    }

    impl Kernel for V3 {
        #[inline(always)]
        fn groups<const SHIFT: u32, const BYTES: usize>(
            self,
            layout: &Layout<BYTES>,
            groups: &[[u8; BYTES]],
            pixels: &mut [[u16; GROUP]],
        ) -> usize {
            let (avx, avx2) = (self.avx, self.avx2);
            let (shuffle, scale) = (cast(shuffle::<32, BYTES>(layout)), cast(scale::<16, BYTES>(layout)));
            let (high_mask, low_mask) = (cast([layout.high_mask; 16]), cast([layout.low_mask; 16]));
            let shifted = |word| match SHIFT {
                4 => avx2._mm256_srli_epi16::<4>(word),
                _ => avx2._mm256_srli_epi16::<6>(word),
            };

            let bytes = groups.as_flattened();
            let mut done = 0;
            for pixels in pixels.as_chunks_mut::<WHOLE>().0 {
                let halves = (half(bytes, done * BYTES), half(bytes, (done + HALF) * BYTES));
                let (Some(first), Some(second)) = halves else { break };
                let word = avx2._mm256_shuffle_epi8(avx._mm256_set_m128i(second, first), shuffle);
                let high = avx2._mm256_and_si256(shifted(word), high_mask);
                let low = avx2._mm256_and_si256(shifted(avx2._mm256_mullo_epi16(word, scale)), low_mask);
                *pixels = cast(avx2._mm256_or_si256(high, low));
                done += WHOLE;
            }
            done
        }
    }
}
