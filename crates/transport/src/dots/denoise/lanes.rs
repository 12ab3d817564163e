//! The vector instructions of the pass over a frame, 32 pixels at a time.

/// 32 adjacent pixels in registers.
///
/// Benefit: plain loops over the same arrays, vectorised by the compiler, take 2 to 4 times as long
/// (`cargo xtask bench dots`).
pub(super) trait Lanes: Copy {
    /// 32 signed 16-bit numbers.
    type I16: Copy;
    /// 16 signed 32-bit numbers.
    type I32: Copy;

    fn load(self, counts: &[u16; 32]) -> Self::I16;
    fn all(self, value: i16) -> Self::I16;
    fn subtract(self, a: Self::I16, b: Self::I16) -> Self::I16;
    fn or(self, a: Self::I16, b: Self::I16) -> Self::I16;
    fn max(self, a: Self::I16, b: Self::I16) -> Self::I16;
    /// `max(a, b)` where the bit is 0, `a` where it is 1.
    fn max_except(self, a: Self::I16, b: Self::I16, except: u32) -> Self::I16;
    /// One bit per lane, set where it equals `value`.
    fn equal(self, a: Self::I16, value: i16) -> u32;
    fn to_array(self, a: Self::I16) -> [i16; 32];
    /// Sums of adjacent pairs.
    fn pair_sums(self, a: Self::I16) -> Self::I32;
    /// Sums of the squares of adjacent pairs, modulo 2^32.
    fn pair_squares(self, a: Self::I16) -> Self::I32;
    fn load_sums(self, sums: &[i32; 16]) -> Self::I32;
    fn add(self, a: Self::I32, b: Self::I32) -> Self::I32;
    fn to_sums(self, a: Self::I32) -> [i32; 16];
}

/// Plain arrays, for machines without the vector instructions.
#[derive(Clone, Copy)]
pub(super) struct Portable;

impl Lanes for Portable {
    type I16 = [i16; 32];
    type I32 = [i32; 16];

    #[inline(always)]
    fn load(self, counts: &[u16; 32]) -> [i16; 32] {
        counts.map(|count| count as i16)
    }

    #[inline(always)]
    fn all(self, value: i16) -> [i16; 32] {
        [value; 32]
    }

    #[inline(always)]
    fn subtract(self, a: [i16; 32], b: [i16; 32]) -> [i16; 32] {
        std::array::from_fn(|lane| a[lane].wrapping_sub(b[lane]))
    }

    #[inline(always)]
    fn or(self, a: [i16; 32], b: [i16; 32]) -> [i16; 32] {
        std::array::from_fn(|lane| a[lane] | b[lane])
    }

    #[inline(always)]
    fn max(self, a: [i16; 32], b: [i16; 32]) -> [i16; 32] {
        std::array::from_fn(|lane| a[lane].max(b[lane]))
    }

    #[inline(always)]
    fn max_except(self, a: [i16; 32], b: [i16; 32], except: u32) -> [i16; 32] {
        std::array::from_fn(|lane| if except >> lane & 1 == 1 { a[lane] } else { a[lane].max(b[lane]) })
    }

    #[inline(always)]
    fn equal(self, a: [i16; 32], value: i16) -> u32 {
        a.iter().enumerate().fold(0, |mask, (lane, &a)| mask | u32::from(a == value) << lane)
    }

    #[inline(always)]
    fn to_array(self, a: [i16; 32]) -> [i16; 32] {
        a
    }

    #[inline(always)]
    fn pair_sums(self, a: [i16; 32]) -> [i32; 16] {
        std::array::from_fn(|pair| i32::from(a[2 * pair]) + i32::from(a[2 * pair + 1]))
    }

    #[inline(always)]
    fn pair_squares(self, a: [i16; 32]) -> [i32; 16] {
        let square = |a: i16| i32::from(a) * i32::from(a);
        std::array::from_fn(|pair| square(a[2 * pair]).wrapping_add(square(a[2 * pair + 1])))
    }

    #[inline(always)]
    fn load_sums(self, sums: &[i32; 16]) -> [i32; 16] {
        *sums
    }

    #[inline(always)]
    fn add(self, a: [i32; 16], b: [i32; 16]) -> [i32; 16] {
        std::array::from_fn(|lane| a[lane].wrapping_add(b[lane]))
    }

    #[inline(always)]
    fn to_sums(self, a: [i32; 16]) -> [i32; 16] {
        a
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::{__m256i, __m512i};

    use pulp::cast;
    use pulp::x86::{V3, V4};

    use super::Lanes;

    impl Lanes for V4 {
        type I16 = __m512i;
        type I32 = __m512i;

        #[inline(always)]
        fn load(self, counts: &[u16; 32]) -> __m512i {
            cast(*counts)
        }

        #[inline(always)]
        fn all(self, value: i16) -> __m512i {
            self.avx512f._mm512_set1_epi16(value)
        }

        #[inline(always)]
        fn subtract(self, a: __m512i, b: __m512i) -> __m512i {
            self.avx512bw._mm512_sub_epi16(a, b)
        }

        #[inline(always)]
        fn or(self, a: __m512i, b: __m512i) -> __m512i {
            self.avx512f._mm512_or_si512(a, b)
        }

        #[inline(always)]
        fn max(self, a: __m512i, b: __m512i) -> __m512i {
            self.avx512bw._mm512_max_epi16(a, b)
        }

        #[inline(always)]
        fn max_except(self, a: __m512i, b: __m512i, except: u32) -> __m512i {
            self.avx512bw._mm512_mask_max_epi16(a, !except, a, b)
        }

        #[inline(always)]
        fn equal(self, a: __m512i, value: i16) -> u32 {
            self.avx512bw._mm512_cmpeq_epi16_mask(a, self.all(value))
        }

        #[inline(always)]
        fn to_array(self, a: __m512i) -> [i16; 32] {
            cast(a)
        }

        #[inline(always)]
        fn pair_sums(self, a: __m512i) -> __m512i {
            self.avx512bw._mm512_madd_epi16(a, self.all(1))
        }

        #[inline(always)]
        fn pair_squares(self, a: __m512i) -> __m512i {
            self.avx512bw._mm512_madd_epi16(a, a)
        }

        #[inline(always)]
        fn load_sums(self, sums: &[i32; 16]) -> __m512i {
            cast(*sums)
        }

        #[inline(always)]
        fn add(self, a: __m512i, b: __m512i) -> __m512i {
            self.avx512f._mm512_add_epi32(a, b)
        }

        #[inline(always)]
        fn to_sums(self, a: __m512i) -> [i32; 16] {
            cast(a)
        }
    }

    impl Lanes for V3 {
        type I16 = [__m256i; 2];
        type I32 = [__m256i; 2];

        #[inline(always)]
        fn load(self, counts: &[u16; 32]) -> [__m256i; 2] {
            cast(*counts)
        }

        #[inline(always)]
        fn all(self, value: i16) -> [__m256i; 2] {
            [self.avx._mm256_set1_epi16(value); 2]
        }

        #[inline(always)]
        fn subtract(self, a: [__m256i; 2], b: [__m256i; 2]) -> [__m256i; 2] {
            [self.avx2._mm256_sub_epi16(a[0], b[0]), self.avx2._mm256_sub_epi16(a[1], b[1])]
        }

        #[inline(always)]
        fn or(self, a: [__m256i; 2], b: [__m256i; 2]) -> [__m256i; 2] {
            [self.avx2._mm256_or_si256(a[0], b[0]), self.avx2._mm256_or_si256(a[1], b[1])]
        }

        #[inline(always)]
        fn max(self, a: [__m256i; 2], b: [__m256i; 2]) -> [__m256i; 2] {
            [self.avx2._mm256_max_epi16(a[0], b[0]), self.avx2._mm256_max_epi16(a[1], b[1])]
        }

        #[inline(always)]
        fn max_except(self, a: [__m256i; 2], b: [__m256i; 2], except: u32) -> [__m256i; 2] {
            let bits: __m256i = cast(std::array::from_fn::<u16, 16, _>(|lane| 1 << lane));
            let half = |a: __m256i, b: __m256i, except: u32| {
                let chosen = self.avx2._mm256_and_si256(self.avx._mm256_set1_epi16(except as i16), bits);
                let chosen = self.avx2._mm256_cmpeq_epi16(chosen, bits);
                self.avx2._mm256_blendv_epi8(self.avx2._mm256_max_epi16(a, b), a, chosen)
            };
            [half(a[0], b[0], except & 0xffff), half(a[1], b[1], except >> 16)]
        }

        #[inline(always)]
        fn equal(self, a: [__m256i; 2], value: i16) -> u32 {
            let values = self.all(value);
            let low = self.avx2._mm256_cmpeq_epi16(a[0], values[0]);
            let high = self.avx2._mm256_cmpeq_epi16(a[1], values[1]);
            // Packing to bytes works within halves of 128 bits, so the middle quarters come out swapped.
            let bytes = self.avx2._mm256_packs_epi16(low, high);
            let bytes = self.avx2._mm256_permute4x64_epi64::<0b11_01_10_00>(bytes);
            self.avx2._mm256_movemask_epi8(bytes) as u32
        }

        #[inline(always)]
        fn to_array(self, a: [__m256i; 2]) -> [i16; 32] {
            cast(a)
        }

        #[inline(always)]
        fn pair_sums(self, a: [__m256i; 2]) -> [__m256i; 2] {
            let one = self.all(1);
            [self.avx2._mm256_madd_epi16(a[0], one[0]), self.avx2._mm256_madd_epi16(a[1], one[1])]
        }

        #[inline(always)]
        fn pair_squares(self, a: [__m256i; 2]) -> [__m256i; 2] {
            [self.avx2._mm256_madd_epi16(a[0], a[0]), self.avx2._mm256_madd_epi16(a[1], a[1])]
        }

        #[inline(always)]
        fn load_sums(self, sums: &[i32; 16]) -> [__m256i; 2] {
            cast(*sums)
        }

        #[inline(always)]
        fn add(self, a: [__m256i; 2], b: [__m256i; 2]) -> [__m256i; 2] {
            [self.avx2._mm256_add_epi32(a[0], b[0]), self.avx2._mm256_add_epi32(a[1], b[1])]
        }

        #[inline(always)]
        fn to_sums(self, a: [__m256i; 2]) -> [i32; 16] {
            cast(a)
        }
    }
}
