/* Burst alignment, position by position: `offsets.align_in_numpy` in one pass over the card's words. The words of a
   position (64 KB) come from the cache, where they were read to (`chain.py`). The method is described in `offsets.py` and
   `loops.py`, the way of the data in docs/compiled-loops.md. */
#include "passes.h"

#define REFERENCES 4       /* `offsets._REFERENCES` */
#define GOOD 0.5           /* `offsets._GOOD` */
#define ROUNDS 4           /* `offsets._ROUNDS` */
#define UNEXPLAINED 8.0    /* `offsets._UNEXPLAINED` */
#define NEGLIGIBLE 1e-3    /* `offsets._NEGLIGIBLE` */
#define LEAST_LIMIT 1024   /* `offsets._LEAST_LIMIT` */
#define AT_LIMIT 32        /* `offsets._AT_LIMIT` */
#define SMALLEST_GAIN 0.25 /* `high_pass_filter.SMALLEST_GAIN` */

/* `high_pass_filter.Equaliser`; without corners it changes nothing. */
typedef struct {
    int is_signed, corners;
    double sample_rate_hz, reach, even, odd; /* even, odd: factors of `find_taps` */
    const double *corners_hz;
} Equaliser;

/* conj(H) / max(|H|^2, SMALLEST_GAIN^2), `HighPass.inverse`. */
static Complex inverse(const Equaliser *e, double frequency)
{
    double turns = e->is_signed ? frequency - floor(frequency + 0.5) : frequency - floor(frequency);
    double f = turns * e->sample_rate_hz, limit = SMALLEST_GAIN * SMALLEST_GAIN;
    Complex h = {1, 0};
    if (fabs(f) < 1)
        f = 1;
    for (int i = 0; i < e->corners; i++)
        h = times(h, (Complex){1, -e->corners_hz[i] / f});
    double gain = squared(h), part = gain * limit > 1 ? 1 / (gain * limit) : 1;
    return (Complex){h.re * part, h.im * part};
}

/* `Equaliser.taps`. */
static void find_taps(const Equaliser *e, double frequency, Complex *taps)
{
    Complex low = inverse(e, frequency - e->reach), middle = inverse(e, frequency), high = inverse(e, frequency + e->reach);
    Complex both = {((low.re + high.re) / 2 - middle.re) * e->even, ((low.im + high.im) / 2 - middle.im) * e->even};
    Complex apart = {(high.im - low.im) * e->odd, -(high.re - low.re) * e->odd}; /* divided by j */
    taps[0] = (Complex){(both.re - apart.re) / 2, (both.im - apart.im) / 2};
    taps[1] = plus(middle, -1, both);
    taps[2] = plus(taps[0], 1, apart);
}

/* Arrays of one position, per chirp; whole groups of them are used. */
typedef struct {
    double frequency[MOST], found[MOST]; /* offset from the reference chirp; that of the latest pass */
    double coherence[MOST], sorted[MOST]; /* with the reference chirp; work array */
    double left[PARTS * MOST];            /* energy that the others do not explain, [part][chirp] */
    double start[MOST], turns[MOST];      /* frequency to mix down by; phase to remove, in turns */
    Complex product[MOST], found_product[MOST], taps[3 * MOST]; /* amplitudes of the tones at both; equaliser */
    float energy[MOST], first[MOST], second[MOST];              /* weights in either half of the average */
    int peak[MOST];                                             /* largest magnitude of a word */
    uint8_t whole[MOST], usable[MOST]; /* received, neither clipped nor silent nor disturbed; and those of this round */
} Chirps;

/* Results, [position][chirp] unless noted. */
typedef struct {
    float *halves;  /* complex [position][2][RX][block] */
    double *centre; /* [position] */
    uint8_t *good;
    double *frequency, *phase, *amplitude, *gain, *frequency_error, *phase_error, *coherence;
    uint8_t *clipped;
} Aligned;

/* Largest magnitude of words. */
static int32_t largest(const int16_t *restrict words, int count)
{
    int16_t low = 0, high = 0;
    for (int i = 0; i < count; i++) {
        low = words[i] < low ? words[i] : low;
        high = words[i] > high ? words[i] : high;
    }
    return high > -(int32_t)low ? high : -(int32_t)low;
}

/* `offsets.find_clipped` in the received chirps of a burst, words in each. */
static void find_clipped(const int16_t *burst, const uint8_t *valid, int chirps, int words, int full_scale, int *peak,
                         uint8_t *clipped)
{
    int highest = 0;
    for (int k = 0; k < chirps; k++) { /* reads all words in order, into the first caches */
        peak[k] = largest(burst + (size_t)k * words, words);
        clipped[k] = valid[k] && peak[k] >= full_scale;
        highest = valid[k] && peak[k] < full_scale && peak[k] > highest ? peak[k] : highest;
    }
    const int16_t limit = (int16_t)(highest - highest / 2048), low = (int16_t)-limit;
    for (int k = 0; k < chirps && highest >= LEAST_LIMIT; k++) {
        const int16_t *restrict chirp = burst + (size_t)k * words;
        int at_limit = 0, count = valid[k] && peak[k] >= limit ? words : 0;
        for (int i = 0; i < count; i++)
            at_limit += (chirp[i] >= limit) | (chirp[i] <= low);
        clipped[k] |= at_limit > words / AT_LIMIT;
    }
}

/* The lower median of the usable values; 0 without any. */
static double median(const double *values, const uint8_t *usable, int chirps, double *sorted)
{
    int count = 0;
    for (int k = 0; k < chirps; k++)
        if (usable[k]) {
            int i = count++;
            for (; i > 0 && sorted[i - 1] > values[k]; i--)
                sorted[i] = sorted[i - 1];
            sorted[i] = values[k];
        }
    return count ? sorted[(count - 1) / 2] : 0;
}

/* `offsets._find_coherent`: usable chirps with at least GOOD of the median coherence of their position; returns their number. */
static int choose_coherent(const double *coherence, const uint8_t *usable, int chirps, double *sorted, uint8_t *good)
{
    double least = GOOD * median(coherence, usable, chirps, sorted);
    int count = 0;
    for (int k = 0; k < chirps; k++)
        count += good[k] = usable[k] && coherence[k] >= least;
    return count;
}

/* `offsets._find_disturbed`: drop chirps from `whole` that the others explain badly in a part; returns their number. */
static int drop_disturbed(const Work *w, Chirps *c, int count)
{
    int chirps = w->chirps, usable = 0, dropped = 0;
    for (int k = 0; k < chirps; k++)
        usable += c->usable[k];
    for (int p = 0; p < w->parts && usable >= 4; p++) {
        const double *left = c->left + p * chirps;
        double negligible = NEGLIGIBLE * w->part_energy[p] / fmax((double)count * count, 1);
        double least = 1e300, most = 0;
        for (int k = 0; k < chirps; k++) {
            least = c->usable[k] && left[k] < least ? left[k] : least;
            most = c->usable[k] && left[k] > most ? left[k] : most;
        }
        if (most <= UNEXPLAINED * least + negligible)
            continue; /* the usual case, without a median */
        double middle = median(left, c->usable, chirps, c->sorted);
        for (int k = 0; k < chirps; k++) {
            double beside = 1e300; /* least of the two chirps on either side */
            for (int j = k > 2 ? k - 2 : 0; j <= k + 2 && j < chirps; j++)
                beside = j != k && c->usable[j] && left[j] < beside ? left[j] : beside;
            double usual = beside < 1e300 && beside > middle ? beside : middle;
            if (c->usable[k] && c->whole[k] && left[k] > UNEXPLAINED * usual + negligible) {
                c->whole[k] = 0;
                dropped++;
            }
        }
    }
    return dropped;
}

/* `offsets._refer_to_one`: offsets relative to one usable chirp; try another if it matches few of the others. Returns the
   middle of the signal's band. */
static double against_one(Work *w, Chirps *c, const int16_t *words)
{
    int chirps = w->chirps, reference = 0, usable = 0, attempts = 0, is_found = 0;
    double best_sum = -1, best = 0, centre = 0, noise = 4 / sqrt((double)RX * w->n);
    memset(c->coherence, 0, sizeof *c->coherence * chirps);
    memset(c->frequency, 0, sizeof *c->frequency * chirps);
    memset(c->product, 0, sizeof *c->product * chirps);
    for (int k = 0; k < chirps; k++)
        usable += c->usable[k];
    for (int tried = 0; tried < chirps && attempts < REFERENCES && !is_found; tried++) {
        if (!c->usable[tried])
            continue;
        attempts++;
        int matching = 0;
        double sum = 0, middle = match(w, words, tried, c->found, c->found_product, c->energy);
        for (int k = 0; k < chirps; k++) {
            double energy = (double)c->energy[k] * c->energy[tried];
            double match = magnitude(c->found_product[k]) / sqrt(energy > 1e-30 ? energy : 1e-30);
            c->sorted[k] = c->usable[k] && k != tried ? match : 0; /* a chirp always matches itself */
            sum += c->sorted[k];
            matching += c->sorted[k] > noise;
        }
        is_found = 2 * matching >= usable - 1;
        if (sum > best_sum) {
            best_sum = sum;
            reference = tried;
            centre = middle;
            memcpy(c->coherence, c->sorted, sizeof *c->coherence * chirps);
            memcpy(c->frequency, c->found, sizeof *c->frequency * chirps);
            memcpy(c->product, c->found_product, sizeof *c->product * chirps);
        }
    }
    for (int k = 0; k < chirps; k++)
        best = c->coherence[k] > best ? c->coherence[k] : best;
    c->coherence[reference] = c->usable[reference] ? best : 0; /* the reference is as good as its best match */
    return centre;
}

/* Subtract the mean over the good chirps and halve the values; zero where not good. */
static void centre_errors(double *values, const uint8_t *good, int chirps, int count)
{
    double mean = 0;
    for (int k = 0; k < chirps; k++)
        mean += good[k] ? values[k] / count : 0;
    for (int k = 0; k < chirps; k++)
        values[k] = good[k] ? (values[k] - mean) / 2 : 0;
}

/* `offsets._align_round`: one round with the whole chirps; returns the number of disturbed ones, dropped from them. */
static int align_round(Work *w, Chirps *c, const Equaliser *e, const int16_t *words, Aligned out)
{
    int chirps = w->chirps, half = 0;
    memcpy(c->usable, c->whole, chirps);
    *out.centre = against_one(w, c, words);
    int count = choose_coherent(c->coherence, c->usable, chirps, c->sorted, out.good);
    for (int k = 0; k < chirps; k++) {
        c->start[k] = *out.centre + c->frequency[k];
        find_taps(e, c->start[k], c->taps + 3 * k);
    }
    VECTOR
    for (int k = 0; k < chirps; k++) {
        Complex *taps = c->taps + 3 * k, sum = {taps[0].re + taps[1].re + taps[2].re, taps[0].im + taps[1].im + taps[2].im};
        out.gain[k] = magnitude(sum);
        out.phase[k] = angle(times(c->product[k], sum));
        Complex turn = cis(-out.phase[k] / TURN);
        for (int t = 0; t < 3; t++)
            taps[t] = times(taps[t], turn);
    }
    reduce(w, c->start, c->taps);

    /* Each chirp against the sum of the others; its difference from the mean of all chirps is smaller. */
    double level = against_others(w, out.good, c->found, c->found_product, c->energy, out.frequency_error,
                                  out.phase_error, c->left);
    int disturbed = drop_disturbed(w, c, count);
    level = fmax(level / fmax((double)count * count, 1), 1e-30);
    VECTOR
    for (int k = 0; k < chirps; k++) {
        int others = count - out.good[k];
        double part = (double)others / (count > 1 ? count : 1), own = c->energy[k] > 1e-30 ? c->energy[k] : 1e-30;
        double shift = part * angle(c->found_product[k]), phase = (out.phase[k] + shift) / TURN;
        c->found[k] *= part;
        c->turns[k] = shift / TURN;
        out.amplitude[k] = others > 0 ? magnitude(c->found_product[k]) / others / level : 1;
        out.coherence[k] = out.amplitude[k] * sqrt(level / own);
        out.phase[k] = TURN * (phase - floor(phase + 0.5));
        out.frequency[k] = c->frequency[k] + c->found[k];
    }
    count = choose_coherent(out.coherence, c->usable, chirps, c->sorted, out.good);
    for (int k = 0; k < chirps; k++) {
        half += out.good[k];
        float weight = out.good[k] ? 1.0f / count : 0;
        c->first[k] = half % 2 ? weight : 0;
        c->second[k] = half % 2 ? 0 : weight;
    }
    average(w, c->found, c->turns, c->first, c->second, out.halves);
    centre_errors(out.frequency_error, out.good, chirps, count);
    centre_errors(out.phase_error, out.good, chirps, count);
    return disturbed;
}

/* `offsets._align` for one position: find clipped chirps, put the words side by side, and align until none is disturbed. */
static void align_position(Work *w, Chirps *c, const Equaliser *e, const int16_t *words, const uint8_t *valid,
                           int full_scale, Aligned out)
{
    const int chirp = WORDS * w->samples;
    find_clipped(words, valid, w->chirps, chirp, full_scale, c->peak, out.clipped);
    for (int k = 0; k < w->chirps; k++)
        c->whole[k] = valid[k] && !out.clipped[k] && c->peak[k] > 0;
    for (int g = 0; g < w->groups; g++) {
        const int16_t *group[LANES];
        for (int k = 0; k < LANES; k++)
            group[k] = g * LANES + k < w->chirps ? words + (size_t)(g * LANES + k) * chirp + WORDS * w->a : group[0];
        side_by_side(group, WORDS * w->n, w->words + (size_t)g * LANES * WORDS * w->n);
    }
    for (int round = 0; round < ROUNDS && align_round(w, c, e, words, out); round++)
        ; /* again without the disturbed chirps */
}

/* Allocate the arrays as one block of zeros, each on its own cache lines. Returns the block, to be freed; NULL if there is
   not enough memory. */
static void *allocate(Work *w)
{
    float *bins, *places, *grouped; /* these hold integers */
    void *block;
    const size_t chirps = LANES * (size_t)w->groups, values = (size_t)RX * w->blocks, words = (size_t)WORDS * w->n;
    const size_t points = w->table.size, size = LANES * points, row = LANES * (values + 2 * RX);
    float **arrays[] = {&bins, &places, &grouped, &w->table.c, &w->table.s, &w->chosen, &w->re, &w->im, &w->phase_c,
                        &w->phase_s, &w->row_re, &w->row_im, &w->folded_re, &w->folded_im, &w->all_re, &w->all_im};
    const size_t counts[] = {points, points, chirps * words / 2, points, points, words, size, size, LANES * (size_t)w->blocks,
                             LANES * (size_t)w->blocks, row, row, chirps * values, chirps * values, values, values};
    const size_t count = sizeof counts / sizeof *counts, line = 64 / sizeof(float);
    size_t used = 0;
    for (size_t i = 0; i < count; i++)
        used += (counts[i] + line - 1) / line * line;
    if (posix_memalign(&block, 64, sizeof(float) * used))
        return NULL;
    memset(block, 0, sizeof(float) * used);
    for (size_t i = 0, at = 0; i < count; i++) {
        *arrays[i] = (float *)block + at;
        at += (counts[i] + line - 1) / line * line;
    }
    w->table.bin = (int *)bins;
    w->table.place = (int *)places;
    w->words = (int16_t *)grouped;
    return block;
}

/* `offsets.align_row` for four RX. words: int16 [position][chirp][sample][2][RX]; valid [position][chirp]; [a, b): linear
   samples, a whole number of blocks; size: of the transform; filter: sample rate, reach, IF signed, corners; taps and
   flat: `decimate.Decimator`. Returns 0, or 1 if there is not enough memory. */
int NAME(align)(const int16_t *words, const uint8_t *valid, int positions, int chirps, int samples, int a, int b,
                int size, int full_scale, const double *filter, int corners, const float *taps, const float *flat,
                float *halves, double *centre, uint8_t *good, double *frequency, double *phase, double *amplitude,
                double *gain, double *error, double *coherence, uint8_t *clipped)
{
    const double reach = TURN * filter[1] * FOLD; /* angle of a tap at this distance */
    const Equaliser e = {filter[2] != 0, corners, filter[0], filter[1], 1 / (cos(reach) - 1), 1 / (2 * sin(reach)), filter + 3};
    const int blocks = (b - a) / FOLD;
    Work w = {.chirps = chirps, .samples = samples, .a = a, .n = b - a, .blocks = blocks, .table.size = size,
              .groups = (chirps + LANES - 1) / LANES, .parts = blocks < PARTS ? blocks : PARTS, .taps = taps,
              .flat = flat};
    Chirps c = {.usable = {0}};
    void *block = allocate(&w);
    if (!block)
        return 1;
    fill_table(&w.table);
    for (int p = 0; p < w.parts; p++) {
        w.edges[p + 1] = (p + 1) * blocks / w.parts;
        w.part_times[p] = FOLD * (w.edges[p] + w.edges[p + 1] - blocks) / 2.0;
    }
    for (int p = 0; p < positions; p++) {
        size_t at = (size_t)p * chirps;
        const Aligned out = {halves + 4 * (size_t)p * RX * blocks, centre + p, good + at, frequency + at, phase + at,
                             amplitude + at, gain + at, error + 2 * at, error + 2 * at + chirps, coherence + at, clipped + at};
        align_position(&w, &c, &e, words + at * samples * WORDS, valid + at, full_scale, out);
    }
    free(block);
    return 0;
}
