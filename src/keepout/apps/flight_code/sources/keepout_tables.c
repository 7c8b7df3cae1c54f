/* The image of a mission's tables: checked before it is used.
 *
 * 8 bytes "KEEPOUT" and 0; then numbers of 4 bytes, the lowest first: the format; 0x01020304; how many bytes follow the
 * header; their CRC-32 (that of zip and Ethernet); how many parts; then the length of each, and the parts one behind the
 * other. */
#include <string.h>

#include "keepout_internal.h"

#define HEADER 24u

static uint32_t four_bytes(const uint8_t *at)
{
    return (uint32_t)at[0] | ((uint32_t)at[1] << 8) | ((uint32_t)at[2] << 16) | ((uint32_t)at[3] << 24);
}

static uint32_t checksum(const uint8_t *bytes, size_t size)
{
    static const uint32_t of_half[16] = {0x00000000u, 0x1DB71064u, 0x3B6E20C8u, 0x26D930ACu, 0x76DC4190u, 0x6B6B51F4u,
                                         0x4DB26158u, 0x5005713Cu, 0xEDB88320u, 0xF00F9344u, 0xD6D6A3E8u, 0xCB61B38Cu,
                                         0x9B64C2B0u, 0x86D3D2D4u, 0xA00AE278u, 0xBDBDF21Cu};
    uint32_t sum = 0xFFFFFFFFu;
    size_t i;
    for (i = 0u; i < size; i++) {
        sum = sum ^ (uint32_t)bytes[i];
        sum = (sum >> 4) ^ of_half[sum & 15u];
        sum = (sum >> 4) ^ of_half[sum & 15u];
    }
    return sum ^ 0xFFFFFFFFu;
}

/* Where the parts of an image begin and end, in bytes; `wrong` once one is not as long as it must be. */
typedef struct {
    const uint8_t *image;
    uint64_t size;
    uint64_t lengths; /* where the next part's length stands */
    uint64_t next;    /* where the next part begins */
    uint32_t parts;   /* left */
    bool wrong;
} reader;

static const uint8_t *part(reader *from, uint64_t length)
{
    const uint8_t *at = from->image;
    bool good = false;
    if ((from->parts > 0u) && (length == (uint64_t)four_bytes(&from->image[from->lengths])) && (length <= from->size)) {
        if (from->next <= (from->size - length)) {
            good = true;
            at = &from->image[from->next];
            from->next = from->next + length;
            from->lengths = from->lengths + 4u;
            from->parts = from->parts - 1u;
        }
    }
    from->wrong = from->wrong || !good;
    return at;
}

static uint64_t product(const int32_t sizes[3])
{
    return ((uint64_t)(uint32_t)sizes[0] * (uint64_t)(uint32_t)sizes[1]) * (uint64_t)(uint32_t)sizes[2];
}

static void open_spline(reader *from, keepout_spline *field)
{
    int32_t level;
    if (field->levels > 0) {
        field->brick = part(from, 2u * product(field->bricks));
        field->brick_base = part(from, 4u * (uint64_t)field->brick_count);
        field->brick_scale = part(from, 4u * (uint64_t)field->brick_count);
        field->brick_values = part(from, 1024u * (uint64_t)field->brick_count);
        for (level = field->levels - 1; level > 0; level--) {
            const uint64_t blocks = (uint64_t)field->blocks[level - 1];
            field->children[level] = part(from, 16u * (uint64_t)field->blocks[level]);
            field->scale[level - 1] = part(from, 4u * blocks);
            field->detail[level - 1] = part(from, ((level == 1) ? 512u : 1024u) * blocks);
        }
    }
}

int32_t keepout_open(const uint8_t *image, size_t size, const keepout_tables *layout, uint32_t digest,
                     keepout_tables *tables)
{
    int32_t answer = KEEPOUT_IMAGE_GOOD;
    const size_t length = (size < (size_t)HEADER) ? 0u : (size_t)four_bytes(&image[16]);
    if (size < (size_t)HEADER) {
        answer = KEEPOUT_IMAGE_SHORT;
    } else if (memcmp(image, "KEEPOUT", 8u) != 0) {
        answer = KEEPOUT_IMAGE_NOT_ONE;
    } else if ((four_bytes(&image[8]) != KEEPOUT_FORMAT) || (four_bytes(&image[12]) != 0x01020304u)) {
        answer = KEEPOUT_IMAGE_VERSION;
    } else if (length > (size - (size_t)HEADER)) {
        answer = KEEPOUT_IMAGE_SHORT;
    } else if (four_bytes(&image[20]) != checksum(&image[HEADER], length)) {
        answer = KEEPOUT_IMAGE_DAMAGED;
    } else if (four_bytes(&image[20]) != digest) {
        answer = KEEPOUT_IMAGE_OF_ANOTHER;
    } else {
        keepout_tables made = *layout;
        reader from = {image, (uint64_t)HEADER + (uint64_t)length, (uint64_t)HEADER + 4u, 0u, 0u, false};
        if (length >= 4u) {
            from.parts = four_bytes(&image[HEADER]);
        }
        if ((length < 4u) || (from.parts > ((length - 4u) / 4u))) {
            answer = KEEPOUT_IMAGE_WRONG;
        } else {
            from.next = from.lengths + (4u * (uint64_t)from.parts);
            if (made.guidance.nodes[0] > 0) {
                made.guidance.directions = part(&from, 3u * product(made.guidance.nodes));
            }
            open_spline(&from, &made.law_spline);
            open_spline(&from, &made.guard_spline);
            if (from.wrong || (from.parts != 0u) || (from.next != from.size)) {
                answer = KEEPOUT_IMAGE_WRONG;
            } else {
                *tables = made;
            }
        }
    }
    return answer;
}
